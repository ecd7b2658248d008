"""MDN-RNNs of different kinds on equal data, several seeds each: trained, evolved in, and compared.

Pages: sweep.md, dreams-notes.md.
"""

__all__ = ["trials", "config", "summary"]
