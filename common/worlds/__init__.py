"""What every host knows of the worlds that ship, without their simulators: a file of facts for each world."""

__all__ = ["profile", "shipped", "score_words"]
