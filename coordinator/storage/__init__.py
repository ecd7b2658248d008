"""The run's journal, a copy of its database, a watch over its files, and the world model that it serves.

Pages: files.md, back-up.md, stop-and-resume.md.
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
