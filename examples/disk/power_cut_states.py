"""The states of a disk after a power cut: notes the writes of this process, and builds what POSIX
allows to be left.

Every write, rename, removal, fsync and directory sync below a folder is a step. For every prefix of
the steps, what was not synced may be there, be lost, or be there in part, in any order.
"""

from __future__ import annotations

import builtins
import hashlib
import io
import itertools
import os
import random
import sqlite3
import stat
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

# Lock files carry nothing and are created where missing. SQLite's journal is modelled step by step,
# see `_sqlite`.
_IGNORED = (".lock", "-journal")
_CALLS = ("replace", "rename", "unlink", "remove", "rmdir", "mkdir", "open", "fsync")
# unsynced directory entries of which every subset is tried; above that all, none, and single ones
_MOST_PENDING = 10
_DATABASE = "journal.sqlite"

_open = open  # while a trace replaces it
Content = bytes | None  # None: a folder
Tree = dict[str, Content]  # by path below the root


@dataclass(frozen=True)
class Step:
    """One step towards the disk.

    Attributes:
        kind: "names": entries of the folder ``inode`` change, all at once; "data": the file gets a
            content; "sync".
        inode: number of the file or folder.
        names: new inode of each changed entry; None: removed.
        data: the content after the step.
    """

    kind: str
    inode: int
    names: tuple[tuple[str, int | None], ...] = ()
    data: bytes = b""


@dataclass
class Trace:
    """The steps of one operation on the folder ``root``, from the state that was on the disk before
    it."""

    root: Path
    steps: list[Step] = field(default_factory=list)
    folders: dict[int, dict[str, int]] = field(default_factory=dict)  # as they are now
    files: dict[int, bytes] = field(default_factory=dict)
    before: tuple[dict[int, dict[str, int]], dict[int, bytes]] = field(init=False)

    def __post_init__(self) -> None:
        self._numbers: dict[
            int, int
        ] = {}  # of the file system -> ours, because it uses numbers again
        self._next = 1
        self._ever: set[int] = set()  # folders
        self._guard = threading.RLock()
        self._numbers[os.stat(self.root).st_ino] = 0
        self.folders[0] = {}
        self._look(atomic=False)
        self.steps.clear()
        self.before = ({k: dict(v) for k, v in self.folders.items()}, dict(self.files))

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Note what this process does."""
        with ExitStack() as stack:
            for name in _CALLS:
                stack.enter_context(
                    mock.patch.object(os, name, self._traced(name, getattr(os, name)))
                )
            stack.enter_context(
                mock.patch.object(sqlite3, "connect", self._connect(sqlite3.connect))
            )
            for module in (builtins, io):  # opening for writing creates and truncates
                stack.enter_context(
                    mock.patch.object(module, "open", self._traced("open", module.open))
                )
            yield
        self._look(atomic=False)

    def _traced(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def traced(*args: Any, **options: Any) -> Any:
            if name == "open" and not _writes(args, options):
                return call(*args, **options)
            with self._guard:
                self._look(atomic=False)
                number = self._numbers.get(os.fstat(args[0]).st_ino) if name == "fsync" else None
                result = call(*args, **options)
                if number is not None:
                    self.steps.append(Step("sync", number))
                self._look(atomic=name in ("replace", "rename"))
                return result

        return traced

    def _connect(
        self, connect: Callable[..., sqlite3.Connection]
    ) -> Callable[..., sqlite3.Connection]:
        trace = self

        class Connection(sqlite3.Connection):
            """Notes what each transaction changed."""

            def executescript(self, *args: Any) -> sqlite3.Cursor:
                cursor = super().executescript(*args)
                trace._look(atomic=False, durable=self._durable())
                return cursor

            def __exit__(self, *args: Any) -> Any:
                result = super().__exit__(*args)
                trace._look(atomic=False, durable=self._durable())
                return result

            def _durable(self) -> bool:
                return bool(self.execute("PRAGMA synchronous").fetchone()[0] == 3)

        def connected(*args: Any, **options: Any) -> sqlite3.Connection:
            return connect(*args, factory=Connection, **options)

        return connected

    def _look(self, *, atomic: bool, durable: bool = False) -> None:
        """Compare the folder with the last look and note the changes."""
        with self._guard:
            found: dict[int, dict[str, int]] = {}
            contents: dict[int, bytes] = {}
            self._walk(str(self.root), 0, found, contents)
            born: list[Step] = []
            for folder, names in found.items():
                old = self.folders.get(folder, {})
                changed = [
                    (n, names.get(n)) for n in sorted({*names, *old}) if names.get(n) != old.get(n)
                ]
                for group in (
                    [tuple(changed)] if atomic and changed else [(one,) for one in changed]
                ):
                    born.append(Step("names", folder, group))
            for number, data in contents.items():
                old_data = self.files.get(number, b"")
                if data == old_data:
                    continue
                places = [
                    (f, n) for f, names in found.items() for n, i in names.items() if i == number
                ]
                if places and places[0][1] == _DATABASE:
                    born += self._sqlite(places[0][0], number, old_data, data, durable)
                else:
                    born.append(Step("data", number, data=data))
            self.steps += born
            self.folders = found
            self.files = contents
            known = {*found, *contents}
            self._numbers = {
                inode: number for inode, number in self._numbers.items() if number in known
            }

    def _walk(
        self, path: str, number: int, found: dict[int, dict[str, int]], contents: dict[int, bytes]
    ) -> None:
        names = found[number] = {}
        self._ever.add(number)
        with os.scandir(path) as entries:
            for entry in sorted(entries, key=lambda one: one.name):
                if entry.name.endswith(_IGNORED):
                    continue
                about = entry.stat(follow_symlinks=False)
                if about.st_ino not in self._numbers:
                    self._numbers[about.st_ino], self._next = self._next, self._next + 1
                names[entry.name] = one = self._numbers[about.st_ino]
                if stat.S_ISDIR(about.st_mode):
                    self._walk(entry.path, one, found, contents)
                else:
                    with _open(entry.path, "rb") as file:
                        contents[one] = file.read()

    def _sqlite(
        self, folder: int, number: int, old: bytes, new: bytes, durable: bool
    ) -> list[Step]:
        """Return the steps of a transaction with a rollback journal, in the order that strace
        shows."""
        journal = self._next
        self._next = self._next + 1
        size = struct.unpack(">H", new[16:18])[0]
        pages = len(old) // size
        nonce = 0x5EED
        changed = [
            p
            for p in range(pages)
            if old[p * size : (p + 1) * size] != new[p * size : (p + 1) * size]
        ]
        records = b""
        for page in changed:
            data = old[page * size : (page + 1) * size]
            check = (nonce + sum(data[i] for i in range(size - 200, 0, -200))) & 0xFFFFFFFF
            records += struct.pack(">I", page + 1) + data + struct.pack(">I", check)
        rest = struct.pack(">IIII", nonce, pages, 512, size).ljust(500, b"\0")
        magic = bytes.fromhex("d9d505f920a163d7")
        name = f"{_DATABASE}-journal"
        steps = [
            Step("names", folder, ((name, journal),)),
            Step("data", journal, data=b"\0" * 12 + rest + records),
            Step("sync", journal),
            Step("sync", folder),
            Step("data", journal, data=magic + struct.pack(">I", len(changed)) + rest + records),
            Step("sync", journal),
            Step("data", number, data=new),
            Step("sync", number),
            Step("names", folder, ((name, None),)),
        ]
        return [*steps, Step("sync", folder)] if durable else steps

    def states(self, *, sample: int | None = None, seed: int = 0) -> Iterator[tuple[Tree, bool]]:
        """Yield each state after a power cut once, and whether all steps were done before it.

        Args:
            sample: number of states that are drawn; None: all of them.
            seed: of the draw.
        """
        if sample is not None:
            everything = list(self.states())
            last = [one for one in everything if one[1]]
            rng = random.Random(seed)
            yield from rng.sample(everything, min(sample, len(everything)))
            yield from rng.sample(last, min(max(1, sample // 10), len(last)))
            return
        seen = set()
        durable_names = {k: dict(v) for k, v in self.before[0].items()}
        durable_data = dict(self.before[1])
        names: list[Step] = []
        data: dict[int, list[bytes]] = {}
        for done in range(len(self.steps) + 1):
            step = self.steps[done - 1] if done else None
            if step is not None and step.kind == "names":
                names.append(step)
            elif step is not None and step.kind == "data":
                data.setdefault(step.inode, []).append(step.data)
            elif step is not None:
                for one in [one for one in names if one.inode == step.inode]:
                    _apply(durable_names, one)
                names = [one for one in names if one.inode != step.inode]
                if step.inode in data:
                    durable_data[step.inode] = data.pop(step.inode)[-1]
                names = _reachable(durable_names, names)
            complete = done == len(self.steps)
            for chosen in _choices(names):
                folders = {k: dict(v) for k, v in durable_names.items()}
                for one in chosen:
                    _apply(folders, one)
                layout = _paths(folders)
                unsynced = {
                    n: _contents(durable_data.get(n, b""), data[n])
                    for n in set(layout.values()) & set(data)
                }
                for contents in itertools.product(*unsynced.values()):
                    written = dict(zip(unsynced, contents, strict=True))
                    tree: Tree = {
                        path: None if n in self._ever else written.get(n, durable_data.get(n, b""))
                        for path, n in layout.items()
                    }
                    key = (_digest(tree), complete)
                    if key not in seen:
                        seen.add(key)
                        yield tree, complete


def _writes(args: tuple[Any, ...], options: dict[str, Any]) -> bool:
    mode = options.get("mode", options.get("flags", args[1] if len(args) > 1 else "r"))
    return bool(
        mode & (os.O_WRONLY | os.O_RDWR) if isinstance(mode, int) else set(mode) & set("wxa+")
    )


def _apply(folders: dict[int, dict[str, int]], step: Step) -> None:
    entries = folders.setdefault(step.inode, {})
    for name, number in step.names:
        if number is None:
            entries.pop(name, None)
        else:
            entries[name] = number


def _reachable(durable: dict[int, dict[str, int]], names: list[Step]) -> list[Step]:
    """Return the unsynced entries whose folder can still be reached, from the root or through
    unsynced entries."""
    alive = {0}
    before = -1
    while len(alive) != before:
        before = len(alive)
        for folder in list(alive):
            alive |= set(durable.get(folder, {}).values())
        alive |= {n for one in names if one.inode in alive for _, n in one.names if n is not None}
    return [one for one in names if one.inode in alive]


def _choices(names: list[Step]) -> Iterator[list[Step]]:
    """Yield the sets of unsynced entries that may have reached the disk."""
    if len(names) <= _MOST_PENDING:
        for chosen in itertools.product((True, False), repeat=len(names)):
            yield [one for one, kept in zip(names, chosen, strict=True) if kept]
        return
    yield from (names[:n] for n in range(len(names) + 1))
    for i in range(len(names)):
        yield [names[i]]
        yield [*names[:i], *names[i + 1 :]]


def _contents(durable: bytes, written: list[bytes]) -> list[bytes]:
    """Return the contents of a file that may be on the disk: before, after, and torn between two
    writes."""
    possible = {durable: None}
    old = durable
    for new in written:
        common = min(len(old), len(new))
        possible[new] = None
        # cut off
        possible[new[: (common + len(new)) // 2] if len(new) > common else new[:common]] = None
        possible[old[:common] + b"\0" * (len(new) - common)] = None  # the size, but not the data
        for start in range(0, max(len(old), len(new)), 4096):  # one page, and all but one
            end = start + 4096
            page = new[start:end]
            other = old[start:end].ljust(min(4096, max(0, len(new) - start)), b"\0")
            possible[(old[:start].ljust(start, b"\0") + page + old[end:])] = None
            possible[(new[:start] + other + new[end:])] = None
        old = new
    return list(possible)


def _paths(folders: dict[int, dict[str, int]], folder: int = 0, above: str = "") -> dict[str, int]:
    found = {}
    for name, number in folders.get(folder, {}).items():
        found[above + name] = number
        found |= _paths(folders, number, f"{above}{name}/") if number in folders else {}
    return found


def _digest(tree: Tree) -> bytes:
    digest = hashlib.sha256()
    for path in sorted(tree):
        data = tree[path]
        digest.update(
            path.encode() + b"\0" + (b"folder" if data is None else hashlib.sha256(data).digest())
        )
    return digest.digest()


def build(tree: Tree, root: Path) -> None:
    """Write a state into an empty folder."""
    for path in sorted(tree):
        data = tree[path]
        if data is None:
            (root / path).mkdir(exist_ok=True)
        else:
            (root / path).write_bytes(data)
