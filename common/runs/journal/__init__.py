"""What the rows of a journal say together. Pages: files.md, back-up.md."""

__all__ = ["schema", "journal_reader", "checksums", "journal_check", "candidate_counts"]
