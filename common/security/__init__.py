"""A secured fleet: join files, certificates, access rules, connection limits."""
