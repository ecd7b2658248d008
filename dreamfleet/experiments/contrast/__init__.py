"""MDN-RNNs of different kinds on equal data, several seeds each: trained, evolved in, and compared."""

__all__ = ["trials", "config", "summary"]
