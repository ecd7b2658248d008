"""What the rows of a journal say together.

Its pages: docs/reference/files.md, docs/how-to/back-up.md.
"""

__all__ = ["schema", "journal_reader", "checksums", "journal_check", "candidate_counts"]
