"""The run's journal, a copy of its database, and a watch over its files.

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
