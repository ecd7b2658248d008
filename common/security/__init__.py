"""A secured fleet: join files, certificates, access rules, connection limits."""

__all__ = ["credentials", "access_rules", "handshake", "certificate_ledger", "connection_limiter", "host_key"]
