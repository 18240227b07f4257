"""The journal of a bundle: recordings used and results of each maintenance run. Needs no torch."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write
from adaptfault.robot.checksummed_json import Damaged, hash_file
from adaptfault.robot.lock import locked

NAME, _CHECKSUM, _LOCK = "journal.sqlite", "journal.sha256", "journal.lock"
_ASIDE = "journal.damaged.sqlite"

_TABLES = """
    CREATE TABLE IF NOT EXISTS runs (id INTEGER PRIMARY KEY, time TEXT NOT NULL, what TEXT NOT NULL,
                                     document TEXT NOT NULL);
    CREATE TABLE IF NOT EXISTS recordings (digest TEXT PRIMARY KEY, name TEXT NOT NULL, run INTEGER NOT NULL);
    CREATE TABLE IF NOT EXISTS conditions (run INTEGER PRIMARY KEY, cells BLOB NOT NULL);
"""


class Journal:
    """Maintenance runs, confirmations and rollbacks in order, in an SQLite file.

    SQLite makes each transaction atomic. A file beside it holds the SHA-256 of the database, which detects later bit
    flips.
    """

    def __init__(self, bundle: Path) -> None:
        self.bundle, self.path = bundle, bundle / NAME

    def damage(self, *, repair: bool) -> list[str]:
        """Return the damage of the file; ``repair`` renames a broken file and starts a new one.

        A crash between a transaction and its checksum leaves an intact file with an old checksum, which is rewritten.
        """
        with locked(self.bundle / _LOCK, wait=True, optional=not repair):
            if not self.path.exists():
                return (
                    [f"{self.path} is missing: a new journal is started"] if (self.bundle / _CHECKSUM).exists() else []
                )
            checksum = self.bundle / _CHECKSUM
            if checksum.is_file() and checksum.read_bytes().decode("latin-1") == hash_file(self.path):
                return []
            try:
                with closing(self._connect()) as connection:
                    intact = connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
                    for (document,) in connection.execute("SELECT document FROM runs"):
                        json.loads(document)
            except (sqlite3.DatabaseError, ValueError):
                intact = False
            if intact:
                if repair:
                    self._write_checksum()
                return [f"{self.path} differs from its checksum (other program, or a crash); it is readable"]
            if repair:
                self.path.replace(self.path.with_name(_ASIDE))
                checksum.unlink(missing_ok=True)
            return [f"{self.path} is damaged: it is renamed to {_ASIDE} and a new journal is started"]

    def add(
        self,
        time: str,
        what: str,
        document: Mapping[str, Any],
        recordings: Sequence[tuple[str, str]] = (),
        condition: bytes | None = None,
    ) -> int:
        """Add a run in one transaction and return its number.

        Args:
            time, what, document: of the run.
            recordings: ``(digest, name)`` of those that it used.
            condition: of the cells, as :mod:`adaptfault.robot.ageing` encodes it; None: no row.
        """
        with self._connection() as connection, connection:
            cursor = connection.execute(
                "INSERT INTO runs (time, what, document) VALUES (?, ?, ?)",
                (time, what, json.dumps(document, allow_nan=False)),
            )
            rows = [(digest, name, cursor.lastrowid) for digest, name in recordings]
            connection.executemany("INSERT OR IGNORE INTO recordings VALUES (?, ?, ?)", rows)
            if condition is not None:
                connection.execute("INSERT INTO conditions VALUES (?, ?)", (cursor.lastrowid, condition))
            return int(cursor.lastrowid or 0)

    def seen(self, digests: Sequence[str]) -> set[str]:
        """Return those of the recordings that an earlier run used."""
        if not self.path.exists():
            return set()
        with self._reading() as connection:
            known = {digest for (digest,) in connection.execute("SELECT digest FROM recordings")}
        return known & set(digests)

    def runs(self, last: int | None = None) -> list[dict[str, Any]]:
        """Return the runs, oldest first: each document with ``id``, ``time`` and ``what``."""
        if not self.path.exists():
            return []
        with self._reading() as connection:
            query = "SELECT id, time, what, document FROM runs ORDER BY id DESC LIMIT ?"
            rows = connection.execute(query, (-1 if last is None else last,)).fetchall()
        return [{**json.loads(text), "id": i, "time": time, "what": what} for i, time, what, text in reversed(rows)]

    def conditions(self) -> list[tuple[int, str, bytes]]:
        """Return number, time and condition of the cells of each run that has one, oldest first."""
        if not self.path.exists():
            return []
        with self._reading() as connection:
            if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'conditions'").fetchone():
                return []  # an earlier version wrote the journal
            query = "SELECT run, time, cells FROM conditions JOIN runs ON runs.id = run ORDER BY run"
            return list(connection.execute(query))

    def last(self, key: str) -> Any:
        """Return the value of ``key`` in the last run that has it; None if no run has it."""
        if not self.path.exists():
            return None
        with self._reading() as connection:
            for (text,) in connection.execute("SELECT document FROM runs ORDER BY id DESC"):
                if key in (document := json.loads(text)):
                    return document[key]
        return None

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with locked(self.bundle / _LOCK, wait=True, optional=True), closing(self._connect()) as connection:
            try:
                yield connection
            except sqlite3.DatabaseError as error:
                raise Damaged(f"{self.path} is damaged ({error}); adaptfault maintain starts a new one") from None

    def _connect(self) -> sqlite3.Connection:
        """Connect for reading: with write access where possible, because SQLite rolls back after a crash."""
        if os.access(self.path, os.W_OK) and os.access(self.bundle, os.W_OK):
            return sqlite3.connect(self.path)
        return sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        with locked(self.bundle / _LOCK, wait=True):
            with closing(sqlite3.connect(self.path)) as connection:
                connection.execute("PRAGMA synchronous=EXTRA")  # FULL may lose a committed run at a power cut
                connection.executescript(_TABLES)
                yield connection
            self._write_checksum()

    def _write_checksum(self) -> None:
        atomic_write(self.bundle / _CHECKSUM, hash_file(self.path).encode())
