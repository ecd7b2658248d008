"""Looking at runs on disk: list, show, plot, receipt, export, backup, story.

Its pages: docs/how-to/export.md, docs/how-to/back-up.md, docs/how-to/watch.md, docs/reference/files.md.
"""

__all__ = ["verb", "analysis_verb", "stored_run", "export", "plot", "run_details", "story_verb"]
