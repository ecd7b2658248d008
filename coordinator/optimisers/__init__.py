"""What decides which candidates to try: each optimiser is a class behind one contract, found by its name.

Pages: optimisers.md, protocol.md.
"""

__all__ = ["api", "evolution", "pycma", "checkpoint"]
