"""The run's journal, a copy of its database, and a watch over its files."""

__all__ = [
    "journal",
    "journal_file",
    "batch_records",
    "verification_records",
    "served_bundle",
    "kept_revocations",
    "file_watch",
]
