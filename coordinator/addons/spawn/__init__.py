"""Start workers on other hosts over ssh, each in its own folder there.

Its pages: docs/how-to/hosts.md, docs/how-to/share-a-fleet.md, docs/how-to/troubleshooting.md.
"""

__all__ = ["verb"]
