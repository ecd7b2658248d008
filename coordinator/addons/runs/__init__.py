"""Looking at runs on disk: list, show, plot, receipt, export, backup, story.

Pages: export.md, back-up.md, watch.md, files.md.
"""

__all__ = ["verb", "analysis_verb", "stored_run", "export", "plot", "run_details", "story_verb"]
