"""What the rows of a journal say together."""

__all__ = ["schema", "journal_reader", "checksums", "journal_check", "candidate_counts"]
