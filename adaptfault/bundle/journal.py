"""The journal of a bundle: recordings used and results of each maintenance run. Needs no torch."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from adaptfault.bundle.checksummed_json import (
    Damaged,
    decoding,
    hash_file,
    read_checksummed,
    write_checksummed,
)
from adaptfault.bundle.lock import PATIENCE, Busy, locked
from adaptfault.data.atomic import atomic_write

if TYPE_CHECKING:
    from diagnostics import FaultSet

NAME = "journal.sqlite"
_CHECKSUM = "journal.sha256"
_LOCK = "journal.lock"
PENDING = "journal.pending.json"
_PENDING_SCHEMA = "adaptfault.pending/1"
_ASIDE = "journal.damaged.sqlite"

_TABLES = {
    "runs": (
        "id INTEGER PRIMARY KEY, entry TEXT NOT NULL UNIQUE, time TEXT NOT NULL, what TEXT NOT"
        " NULL, document TEXT NOT NULL"
    ),
    "recordings": "digest TEXT PRIMARY KEY, name TEXT NOT NULL, run INTEGER NOT NULL",
    "conditions": "run INTEGER PRIMARY KEY, cells BLOB NOT NULL",
}

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """One entry of the journal.

    Attributes:
        time: ISO 8601.
        what: "deployed", "unchanged", "kept", "refused", "confirmed" or "rollback".
        document: JSON-safe.
        recordings: ``(digest, name)`` of those that the run used.
        condition: of the D cells, 9 bytes each: ``[4, D]`` of
            :class:`~diagnostics.sensor.ageing.CellCondition` as little-endian float16, then the
            verdicts ``[D]`` as int8; None: no row.
        key: identifies the entry, so that it is journalled once.
    """

    time: str
    what: str
    document: Mapping[str, Any]
    recordings: Sequence[tuple[str, str]] = ()
    condition: bytes | None = None
    key: str = field(default_factory=lambda: uuid4().hex)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "time": self.time,
            "what": self.what,
            "document": dict(self.document),
            "recordings": [list(one) for one in self.recordings],
            "condition": None if self.condition is None else b64encode(self.condition).decode(),
            "key": self.key,
        }

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Entry:
        """Return what :meth:`to_dict` was called on."""
        recordings = tuple((str(digest), str(name)) for digest, name in d["recordings"])
        condition = None if d["condition"] is None else b64decode(d["condition"])
        return cls(
            str(d["time"]),
            str(d["what"]),
            dict(d["document"]),
            recordings,
            condition,
            str(d["key"]),
        )


class Journal:
    """Maintenance runs, confirmations and rollbacks in order, in an SQLite file.

    SQLite makes each transaction atomic. A file beside it holds the SHA-256 of the database, which
    detects later bit flips.

    A switch of the active version and its entry are one step: the entry is written to
    ``journal.pending.json`` (:meth:`prepare`), the pointer that names its key is replaced, and
    :meth:`settle` moves the entry into the database. An entry that no pointer names never happened.
    Where the database cannot be written, the entry waits.
    """

    def __init__(self, bundle: Path) -> None:
        self.bundle = bundle
        self.path = bundle / NAME
        self._pending = bundle / PENDING
        self._told = False  # that entries wait

    def damage(self, *, repair: bool) -> list[str]:
        """Return the damage of the file; ``repair`` renames a broken file and starts a new one.

        A crash between a transaction and its checksum leaves an intact file with an old checksum,
        which is rewritten. A file without tables and without checksum was never finished, and holds
        nothing.

        Raises:
            OSError: the file cannot be read now. It stays as it is: it may be whole.
        """
        with self._locked(needed=repair):
            if not self.path.exists():
                return (
                    [f"{self.path} is missing: a new journal is started"]
                    if self._checksum.exists()
                    else []
                )
            if self._recorded() == hash_file(self.path):
                return []
            try:
                intact = self._intact()
            except (Damaged, ValueError):
                intact = False
            if intact and not self._checksum.exists():
                return []
            if intact:
                if repair:
                    self._try_to_write_checksum()
                return [
                    f"{self.path} differs from its checksum (other program, or a crash); it is"
                    " readable"
                ]
            if repair:
                self.path.replace(self.path.with_name(_ASIDE))
                with suppress(OSError):  # the new journal writes it anew
                    self._checksum.unlink()
            return [
                f"{self.path} is damaged: it is renamed to {_ASIDE} and a new journal is started"
            ]

    def _intact(self) -> bool:
        """Return whether every row can be read; raises Damaged or ValueError where one cannot."""
        with self._connect() as connection:
            if connection.execute("PRAGMA integrity_check").fetchone() != ("ok",):
                return False
            if not self._has_tables(connection):
                return not self._checksum.exists()
            for (document,) in connection.execute("SELECT document FROM runs"):
                json.loads(document)
            for table in ("recordings", "conditions"):
                connection.execute(f"SELECT count(*) FROM {table}").fetchone()
        return True

    def add(self, entry: Entry) -> None:
        """Add an entry in one transaction; one that is there already is not added again.

        Raises:
            OSError: the journal cannot be written now.
            ValueError: the document does not fit into JSON.
        """
        self._insert([entry], PATIENCE)

    @property
    def waits(self) -> bool:
        """Whether there are entries that are not in the database yet."""
        return self._pending.exists()

    def prepare(self, entry: Entry, active: str) -> None:
        """Write an entry that counts once a pointer names its key.

        Args:
            entry: of the switch that follows.
            active: key that the pointer names now.
        """
        try:
            waiting = self._waiting(active)
        except Damaged as error:
            _log.warning("entries that waited for the journal are lost: %s", error)
            waiting = []
        document = {
            "schema": _PENDING_SCHEMA,
            "entries": [one.to_dict() for one in (*waiting, entry)],
        }
        write_checksummed(self._pending, document)

    def settle(self, active: str, *, patience: float = PATIENCE) -> bool:
        """Move the entries that count into the database; return whether none is left.

        Where the database cannot be written they wait for the next call, which is told once.

        Args:
            active: key that the pointer names.
            patience: seconds to wait for another program that holds the journal.
        """
        try:
            if not self.waits:
                return True
            waiting = self._waiting(active)
            if waiting:
                self._insert(waiting, patience)
            self._pending.unlink(missing_ok=True)
        except (OSError, Damaged, MemoryError) as error:
            if not self._told:
                _log.warning(
                    "%s cannot be written; its new entries wait in %s: %s",
                    self.path,
                    PENDING,
                    error,
                )
            self._told = True
            return False
        return True

    def _waiting(self, active: str) -> list[Entry]:
        """Return the entries that count and are not in the database; all but the last do, as they
        waited before.

        Raises:
            Damaged: they cannot be read; by another attempt they may be.
        """
        try:
            with decoding(self._pending):
                document = read_checksummed(self._pending, _PENDING_SCHEMA)
                entries = [Entry.from_dict(one) for one in document["entries"]]
        except FileNotFoundError:
            return []
        return entries if entries and entries[-1].key == active else entries[:-1]

    def seen(self, digests: Sequence[str]) -> set[str]:
        """Return those of the recordings that an earlier run used."""
        known = {digest for (digest,) in self._select("SELECT digest FROM recordings")}
        return known & set(digests)

    def runs(self, last: int | None = None) -> list[dict[str, Any]]:
        """Return the runs, oldest first: each document with ``id``, ``time`` and ``what``."""
        query = "SELECT id, time, what, document FROM runs ORDER BY id DESC LIMIT ?"
        rows = list(self._select(query, (-1 if last is None else last,)))
        return [
            {**json.loads(text), "id": i, "time": time, "what": what}
            for i, time, what, text in reversed(rows)
        ]

    def conditions(self) -> list[tuple[int, str, bytes]]:
        """Return number, time and condition of the cells of each run that has one, oldest first."""
        return list(
            self._select(
                "SELECT run, time, cells FROM conditions JOIN runs ON runs.id = run ORDER BY run"
            )
        )

    def last(self, key: str) -> Any:
        """Return the value of ``key`` in the last run that has it; None if no run has it."""
        for (text,) in self._select("SELECT document FROM runs ORDER BY id DESC"):
            document = json.loads(text)
            if key in document:
                return document[key]
        return None

    def judged(self, faulty: FaultSet, version: int) -> dict[str, Any] | None:
        """Return the last comparison if it was for these faults and this version; None
        otherwise."""
        judged = self.last("judged")
        if judged is None:
            return None
        asked = (faulty.cells, version)
        return dict(judged) if (tuple(judged["fault_set"]), judged["version"]) == asked else None

    def _select(self, query: str, parameters: Sequence[Any] = ()) -> Iterator[Any]:
        """Yield rows; none where there is no journal yet.

        Raises:
            Damaged: the content of the journal is not what was written.
            OSError: it cannot be read now.
        """
        if not self.path.exists():
            return
        with self._locked(needed=False), self._connect() as connection:
            whole = self._has_tables(connection)
            if whole:
                yield from connection.execute(query, parameters)
        if not whole and self._checksum.exists():
            raise Damaged(
                f"{self.path} is damaged (tables are missing); adaptfault maintain starts a new one"
            )

    def _insert(self, entries: Sequence[Entry], patience: float) -> None:
        """Insert entries in one transaction, which makes the tables, too, where there are none."""
        with self._locked(patience):
            with self._connect(patience) as connection:
                # FULL may lose a committed run at a power cut
                connection.execute("PRAGMA synchronous=EXTRA")
                connection.execute("BEGIN IMMEDIATE")
                for name, columns in _TABLES.items():
                    connection.execute(f"CREATE TABLE IF NOT EXISTS {name} ({columns})")
                for entry in entries:
                    _insert(connection, entry)
                connection.execute("COMMIT")
            self._try_to_write_checksum()

    @contextmanager
    def _connect(self, patience: float = PATIENCE) -> Iterator[sqlite3.Connection]:
        """Connect, with write access where possible, because SQLite rolls back after a crash.

        Raises:
            Damaged: SQLite says that the file is none of its own, or corrupt.
            Busy: another program holds it.
            OSError: any other error of SQLite, as of a full disk; the file may be whole.
        """
        if not self.path.exists() or (
            os.access(self.path, os.W_OK) and os.access(self.bundle, os.W_OK)
        ):
            name = self.path.resolve().as_uri()
        else:
            name = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
        try:
            with closing(
                sqlite3.connect(name, timeout=patience, isolation_level=None, uri=True)
            ) as connection:
                yield connection
        except sqlite3.Error as error:
            raise self._translated(error) from None

    def _translated(self, error: sqlite3.Error) -> Exception:
        """Return an error of SQLite as one of ours."""
        if type(error) is sqlite3.DatabaseError:  # of SQLITE_CORRUPT and SQLITE_NOTADB alone
            return Damaged(
                f"{self.path} is damaged ({error}); adaptfault maintain starts a new one"
            )
        if "locked" in str(error):
            return Busy(f"{self.path} is held by another program ({error}); try again later")
        return OSError(f"{self.path}: {error}")

    @staticmethod
    def _has_tables(connection: sqlite3.Connection) -> bool:
        names = {
            name
            for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        }
        return names >= _TABLES.keys()

    def _locked(
        self, patience: float = PATIENCE, *, needed: bool = True
    ) -> AbstractContextManager[None]:
        return locked(self.bundle / _LOCK, patience=patience, needed=needed)

    @property
    def _checksum(self) -> Path:
        return self.bundle / _CHECKSUM

    def _recorded(self) -> str:
        """Return the SHA-256 that is recorded of the database; "" where it cannot be read."""
        try:
            return self._checksum.read_bytes().decode("latin-1")
        except OSError:
            return ""

    def _try_to_write_checksum(self) -> None:
        """Record the SHA-256 of the database; the next check does it where that fails, and what
        counts is in the database."""
        try:
            atomic_write(self._checksum, hash_file(self.path).encode())
        except (OSError, MemoryError) as error:
            _log.warning("%s cannot be written: %s", self._checksum, error)


def _insert(connection: sqlite3.Connection, entry: Entry) -> None:
    """Insert one entry within a transaction; nothing where it is there already."""
    document = json.dumps(entry.document, allow_nan=False)
    cursor = connection.execute(
        "INSERT OR IGNORE INTO runs (entry, time, what, document) VALUES (?, ?, ?, ?)",
        (entry.key, entry.time, entry.what, document),
    )
    if not cursor.rowcount:
        return
    run = cursor.lastrowid
    rows = [(digest, name, run) for digest, name in entry.recordings]
    connection.executemany("INSERT OR IGNORE INTO recordings VALUES (?, ?, ?)", rows)
    if entry.condition is not None:
        connection.execute("INSERT INTO conditions VALUES (?, ?)", (run, entry.condition))


def now() -> str:
    """Return the current UTC time as ISO 8601."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
