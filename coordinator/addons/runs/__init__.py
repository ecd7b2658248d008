"""Looking at runs on disk: list, show, plot, receipt, export, backup, story."""
