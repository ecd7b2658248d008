"""Start workers on other hosts over ssh, each in its own folder there.

Pages: hosts.md, share-a-fleet.md, troubleshooting.md.
"""

__all__ = ["verb"]
