"""The journal of a bundle: which recordings were seen, and what each maintenance run found and did. Needs no torch."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write
from adaptfault.robot.checksummed_json import hash_file
from adaptfault.robot.lock import locked

NAME, _SEAL, _LOCK = "journal.sqlite", "journal.sha256", "journal.lock"
_ASIDE = "journal.damaged.sqlite"

_TABLES = """
    CREATE TABLE IF NOT EXISTS runs (id INTEGER PRIMARY KEY, time TEXT NOT NULL, what TEXT NOT NULL,
                                     document TEXT NOT NULL);
    CREATE TABLE IF NOT EXISTS recordings (digest TEXT PRIMARY KEY, name TEXT NOT NULL, run INTEGER NOT NULL);
"""


class Journal:
    """What happened to a robot's skin and its classifier, in order.

    SQLite keeps a transaction whole through a crash. A file beside it holds the hash of the whole, so that a bit that
    flips later is noticed too.
    """

    def __init__(self, bundle: Path) -> None:
        self.bundle, self.path = bundle, bundle / NAME

    def damage(self, *, mend: bool) -> list[str]:
        """Return what is wrong with the file; to mend is to set a broken one aside and begin a new one.

        A crash between a transaction and its seal leaves an intact file under an old seal: it is sealed again.
        """
        with locked(self.bundle / _LOCK, wait=True):
            if not self.path.exists():
                return [f"{self.path} is missing: begun anew"] if (self.bundle / _SEAL).exists() else []
            seal = self.bundle / _SEAL
            if seal.exists() and seal.read_text() == hash_file(self.path):
                return []
            try:
                with closing(sqlite3.connect(self.path)) as connection:
                    intact = connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
                    for (document,) in connection.execute("SELECT document FROM runs"):
                        json.loads(document)
            except (sqlite3.DatabaseError, ValueError):
                intact = False
            if intact:
                if mend:
                    self._seal()
                return [f"{self.path} was changed outside, or a crash came before its seal; it reads well"]
            if mend:
                self.path.replace(self.path.with_name(_ASIDE))
                seal.unlink(missing_ok=True)
            return [f"{self.path} is damaged: to be set aside as {_ASIDE}, and begun anew"]

    def add(self, time: str, what: str, document: Mapping[str, Any], recordings: Sequence[tuple[str, str]] = ()) -> int:
        """Add a run and the recordings ``(digest, name)`` that it saw, all or nothing; return its number."""
        with self._connection() as connection, connection:
            cursor = connection.execute(
                "INSERT INTO runs (time, what, document) VALUES (?, ?, ?)",
                (time, what, json.dumps(document, allow_nan=False)),
            )
            rows = [(digest, name, cursor.lastrowid) for digest, name in recordings]
            connection.executemany("INSERT OR IGNORE INTO recordings VALUES (?, ?, ?)", rows)
            return int(cursor.lastrowid or 0)

    def seen(self, digests: Sequence[str]) -> set[str]:
        """Return those of the recordings that an earlier run saw."""
        if not self.path.exists():
            return set()
        with self._reading() as connection:
            known = {digest for (digest,) in connection.execute("SELECT digest FROM recordings")}
        return known & set(digests)

    def runs(self, last: int | None = None) -> list[dict[str, Any]]:
        """Return the runs, the oldest first: each its document with ``id``, ``time`` and ``what``."""
        if not self.path.exists():
            return []
        with self._reading() as connection:
            query = "SELECT id, time, what, document FROM runs ORDER BY id DESC LIMIT ?"
            rows = connection.execute(query, (-1 if last is None else last,)).fetchall()
        return [{**json.loads(text), "id": i, "time": time, "what": what} for i, time, what, text in reversed(rows)]

    def last(self, key: str) -> Any:
        """Return what the last run whose document has this key says there; None if none has it."""
        if not self.path.exists():
            return None
        with self._reading() as connection:
            for (text,) in connection.execute("SELECT document FROM runs ORDER BY id DESC"):
                if key in (document := json.loads(text)):
                    return document[key]
        return None

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        # Not read-only: after a crash SQLite has to roll back first.
        with locked(self.bundle / _LOCK, wait=True), closing(sqlite3.connect(self.path)) as connection:
            yield connection

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        with locked(self.bundle / _LOCK, wait=True):
            with closing(sqlite3.connect(self.path)) as connection:
                connection.executescript(_TABLES)
                connection.execute("PRAGMA synchronous=FULL")
                yield connection
            self._seal()

    def _seal(self) -> None:
        atomic_write(self.bundle / _SEAL, hash_file(self.path).encode())
