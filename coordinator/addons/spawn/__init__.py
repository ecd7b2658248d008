"""Start workers on other hosts over ssh, each in its own folder there."""

__all__ = ["verb"]
