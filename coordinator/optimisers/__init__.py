"""What decides which candidates to try: each optimiser is a class behind one contract, found by its name.

Its pages: docs/reference/optimisers.md, docs/reference/protocol.md.
"""

__all__ = ["api", "evolution", "pycma", "checkpoint"]
