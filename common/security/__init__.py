"""A secured fleet: join files, certificates, access rules, connection limits.

Its pages: docs/how-to/security.md, docs/explanation/threats.md.
"""

__all__ = ["credentials", "access_rules", "handshake", "certificate_ledger", "connection_limiter", "host_key"]
