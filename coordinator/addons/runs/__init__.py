"""Looking at runs on disk: list, show, plot, receipt, export, backup, story."""

__all__ = ["verb", "analysis_verb", "stored_run", "export", "plot", "run_details", "story_verb"]
