"""The run's journal, a copy of its database, and a watch over its files.

Its pages: docs/reference/files.md, docs/how-to/back-up.md, docs/how-to/stop-and-resume.md.
"""

__all__ = [
    "journal",
    "journal_file",
    "batch_records",
    "verification_records",
    "served_bundle",
    "kept_revocations",
    "file_watch",
]
