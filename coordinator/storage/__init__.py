"""The run's journal, its backup, and a watch over its files."""
