"""Runs on disk: their journals as typed records, schedules, seeds, provenance, evaluation reports, statistics.

Pages: files.md, stages.md, stop-and-resume.md, settings.md.
"""

__all__ = [
    "run_folder",
    "run_paths",
    "records",
    "stages",
    "seeds",
    "episode_results",
    "standard_error",
    "paired_difference",
    "effort",
    "run_provenance",
    "lookup",
    "own_runs",
    "run_lock",
]
