"""What an error of SQLite says of a database: that it is damaged, or locked. Of nothing else follows either."""

from __future__ import annotations

import sqlite3


def is_damage(error: BaseException) -> bool:
    """Whether SQLite found the file damaged or no database, or text in it that is not UTF-8.

    A full disk, too many open files or a wrong call say nothing about a journal, and a copy would not help.
    """
    if isinstance(error, UnicodeDecodeError):
        return True
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:  # the module itself raised it: as an `OperationalError` only for text that is not UTF-8
        return isinstance(error, sqlite3.OperationalError)
    return code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def is_locked(error: BaseException) -> bool:
    """Whether another program, such as SQLite's shell, locks the database."""
    return isinstance(error, sqlite3.Error) and getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY
