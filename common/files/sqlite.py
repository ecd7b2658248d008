"""SQLite databases: a connection for each thread that reads one, and what an error says of one. Pages: python.md."""

import sqlite3
from collections.abc import Callable
from threading import Lock, local
from weakref import WeakSet


class ThreadConnection:
    """One thread's connection. What uses or closes it holds its `lock`: only closing comes from other threads."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self.database, self.lock = database, Lock()

    def close(self) -> None:
        """Close it, once a query that is under way has ended."""
        with self.lock:
            self.database.close()

    def __del__(self) -> None:
        """Close the connection of a thread that has ended."""
        self.database.close()


class ThreadConnections:
    """Opens a connection for each thread, so that none sees another one's transaction; `close` closes them all."""

    def __init__(self, connect: Callable[[], sqlite3.Connection]) -> None:
        self.is_closed = False
        self._connect = connect
        self._own = local()
        self._opened: WeakSet[ThreadConnection] = WeakSet()  # a thread that ends drops its own
        self._lock = Lock()

    @property
    def own(self) -> ThreadConnection:
        """The calling thread's connection, which is opened when it is first asked for."""
        found: ThreadConnection | None = getattr(self._own, "connection", None)
        return found or self.add_own(self._connect())

    def add_own(self, database: sqlite3.Connection) -> ThreadConnection:
        """Take an open connection as the calling thread's."""
        found = self._own.connection = ThreadConnection(database)
        with self._lock:
            self._opened.add(found)
        return found

    def close(self) -> None:
        """Close the connections of all threads, from any of them."""
        with self._lock:
            self.is_closed = True
            opened = [*self._opened]
        for each in opened:
            each.close()


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
