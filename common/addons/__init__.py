"""What both sides' add-ons share, and verbs of any host that no run needs."""

__all__ = ["completion", "status_card", "own_modules", "markdown", "evaluation_report"]
