"""MDN-RNNs of different kinds on equal data, several seeds each: trained, evolved in, and compared.

Its pages: docs/how-to/sweep.md, docs/explanation/dreams.md.
"""

__all__ = ["trials", "config", "summary"]
