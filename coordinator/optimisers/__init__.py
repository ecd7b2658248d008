"""What decides which candidates to try: each optimiser is a class behind one contract, found by its name."""

__all__ = ["api", "evolution", "pycma", "checkpoint"]
