"""A secured fleet: join files, certificates, access rules, connection limits. Pages: security.md, threats.md."""

__all__ = ["credentials", "access_rules", "handshake", "certificate_ledger", "connection_limiter", "host_key"]
