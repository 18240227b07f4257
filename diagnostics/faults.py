"""Faults of a tactile array: fault kinds, one root cause (Fault), and the fault set F of the paper
(FaultSet)."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import asdict, dataclass, field
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.wiring import Line


class FaultKind(str, Enum):
    """Kind of a fault. Members are strings (a StrEnum also on Python 3.10)."""

    OPEN = "open"
    """Reads 0: no current flows (a broken wire)."""
    SHORT = "short"
    """Reads full scale (Section I of the paper: 5 N)."""
    STUCK = "stuck"
    """Reads one constant value in between, whatever touches it."""
    ALIAS = "alias"
    """Reads another cell: a stuck address bit."""
    INTERMITTENT = "intermittent"
    """Blinks between its load and a rail: a loose contact."""
    NOISY = "noisy"
    """Reads its load plus excess noise."""
    DRIFT = "drift"
    """Its offset or its gain drifts."""
    FLOATING = "floating"
    """Moves by itself, whatever touches it: a broken wire of high impedance, another signal."""
    LATE = "late"
    """Reads its load some frames late: a stuck buffer."""
    COPY = "copy"
    """Repeats another cell, or the mean of those beside it."""
    CLAMPED = "clamped"
    """Reads its load up to a limit."""
    WEAK = "weak"
    """Reads a share of its load."""

    __str__ = str.__str__

    @property
    def letter(self) -> str:
        """What a map of the cells shows."""
        return _WORDS[self].letter

    @property
    def check(self) -> str:
        """What to check of a single cell."""
        return _WORDS[self].check

    @property
    def does(self) -> str:
        """What a cell does, with ``{value}`` and ``{unit}``; empty: it reads a value."""
        return _WORDS[self].does

    def verb(self, *, plural: bool = False) -> str:
        """Return what a cell or a wire of this kind does or is: "is stuck", "drifts"."""
        single, several = _WORDS[self].verbs or (f"is {self}", f"are {self}")
        return several if plural else single


@dataclass(frozen=True)
class _Words:
    letter: str
    check: str = "the cell and its traces for a short circuit"
    does: str = ""
    verbs: tuple[str, str] | None = None


_WORDS = {
    FaultKind.OPEN: _Words("O", "its solder joint and trace"),
    FaultKind.SHORT: _Words("S"),
    FaultKind.STUCK: _Words("K"),
    FaultKind.ALIAS: _Words("A", verbs=("reads another cell", "read other cells")),
    FaultKind.INTERMITTENT: _Words(
        "I",
        "its solder joint and trace for a loose contact",
        "blinks between its load and {value:.4g} {unit}",
    ),
    FaultKind.NOISY: _Words(
        "N",
        "its connection and shielding",
        "is far noisier than a healthy cell under the same load",
    ),
    FaultKind.DRIFT: _Words(
        "D",
        "the cell for wear or dirt, and calibrate it again",
        "moves, but never returns to its baseline",
        ("drifts", "drift"),
    ),
    FaultKind.FLOATING: _Words(
        "F",
        "its trace for a break: an open input picks up what is around it",
        "moves by itself, whatever the cells around it read",
    ),
    FaultKind.LATE: _Words(
        "L",
        "the converter and the buffer that it is read from",
        "follows the cells around it about {value:.0f} frames late",
    ),
    FaultKind.COPY: _Words(
        "C",
        "the multiplexer and the order in which cells are read",
        verbs=("is a copy", "are copies"),
    ),
    FaultKind.CLAMPED: _Words(
        "M",
        "its amplifier and supply",
        "never reads more than {value:.4g} {unit}, however much the cells around it are loaded",
    ),
    FaultKind.WEAK: _Words(
        "W",
        "the cell for wear or dirt, and calibrate it again",
        "reads {value:.2g} times what it should",
    ),
}


KindName = Literal[
    "open",
    "short",
    "stuck",
    "alias",
    "intermittent",
    "noisy",
    "drift",
    "floating",
    "late",
    "copy",
    "clamped",
    "weak",
]


@dataclass(frozen=True)
class Fault:
    """One root cause: a cell, or every cell behind one broken wire.

    Attributes:
        kind: kind of the fault.
        cells: indices of the faulty cells, ascending and unique.
        line: the wire at fault; None for single cells.
        value: in the layout's unit. OPEN, SHORT, STUCK: what the cells read (None: 0 for OPEN, full
            scale for SHORT). INTERMITTENT: the value they blink to (None: 0). NOISY: standard
            deviation of the added noise. DRIFT: how much the offset moves in one second (a drift of
            the gain is given to ``inject``, as a share per second). ALIAS: the level (0 or 1) of
            the stuck address bit in ``line``; with a row or column line, the index of the row or
            column read instead, or, where ``cells`` holds the cells of both lines, of the one that
            ``line`` touches (a bridge: both read the sum); without a line, the cell read instead.
            FLOATING: the range of its own movement. LATE: the delay in frames. COPY: the cell that
            it repeats (None: the mean of the cells beside it). CLAMPED: the highest reading. WEAK:
            the share of the load that it reads.
        onset: first faulty frame; None: from the first frame on.
        probability: P(the fault exists), 0..1; None: known, not inferred.
        reason: one sentence: what was observed, and what to check.
        evidence: number of independent observations of it (events that tested its cells, blinks,
            coincidences of two lines); None: known, not inferred.
        alternatives: other causes that the data permit, one sentence each.
        recordings: numbers of the recordings in which it shows, ascending, from 0; None: in all
            from its onset on.
    """

    kind: FaultKind
    cells: tuple[int, ...]
    line: Line | None = field(default=None, kw_only=True)
    value: float | None = field(default=None, kw_only=True)
    onset: int | None = field(default=None, kw_only=True)
    probability: float | None = field(default=None, kw_only=True)
    reason: str = field(default="", kw_only=True)
    evidence: int | None = field(default=None, kw_only=True)
    alternatives: tuple[str, ...] = field(default=(), kw_only=True)
    recordings: tuple[int, ...] | None = field(default=None, kw_only=True)

    if TYPE_CHECKING:  # what it takes, beside what it holds

        def __init__(
            self,
            kind: FaultKind | KindName,
            cells: Iterable[int],
            *,
            line: Line | None = None,
            value: float | None = None,
            onset: int | None = None,
            probability: float | None = None,
            reason: str = "",
            evidence: int | None = None,
            alternatives: tuple[str, ...] = (),
            recordings: tuple[int, ...] | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", FaultKind(self.kind))
        cells = np.atleast_1d(np.asarray(self.cells))
        cells = np.unique(np.flatnonzero(cells) if cells.dtype == bool else cells)
        if cells.size == 0 or not np.issubdtype(cells.dtype, np.integer) or cells[0] < 0:
            raise ValueError(
                f"a fault needs at least one cell index, whole and >= 0; got {self.cells!r}"
            )
        object.__setattr__(self, "cells", tuple(cells.tolist()))

    def describe(self, layout: SensorLayout) -> str:
        """Return place and kind in a few words: "pad 0, row 4, column 5: stuck at 2.5 N"."""
        where = (
            str(self.line)
            if self.line is not None
            else "; ".join(layout.place(cell) for cell in self.cells)
        )
        no_reading = (FaultKind.ALIAS, FaultKind.LATE, FaultKind.COPY, FaultKind.WEAK)
        at = (
            ""
            if self.value is None or self.kind in no_reading
            else f" at {self.value:.4g} {layout.unit}"
        )
        return f"{where}: {self.kind}{at}"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        lists = {"cells": list(self.cells), "alternatives": list(self.alternatives)}
        about = {**asdict(self), "kind": str(self.kind), **lists}
        if self.recordings is not None:
            about["recordings"] = list(self.recordings)
        else:
            del about["recordings"]
        if self.line is not None and not self.line.name:
            del about["line"]["name"]  # only groups have one
        return about

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Fault:
        """Rebuild a fault from :meth:`to_dict`.

        Raises:
            ValueError: a field is missing, unknown or of a wrong kind.
        """
        try:
            for name, kinds in _KINDS.items():
                if not isinstance(d.get(name), kinds) or isinstance(d.get(name), bool):
                    raise TypeError(f"field {name!r} is {str(d.get(name))[:30]!r}")
            numbers = [d[name] for name in ("value", "probability") if d.get(name) is not None]
            if not all(np.isfinite(float(number)) for number in numbers):
                raise TypeError("value and probability must be finite")
            alternatives = tuple(d.get("alternatives") or ())
            if not all(isinstance(text, str) for text in alternatives):
                raise TypeError("alternatives must be text")
            line = Line(**d["line"]) if d.get("line") else None
            recordings = d.get("recordings")
            if recordings is not None:
                recordings = tuple(operator.index(number) for number in recordings)
            lists = {
                "cells": tuple(d["cells"]),
                "alternatives": alternatives,
                "recordings": recordings,
            }
            return cls(**{**d, "line": line, "reason": d.get("reason") or "", **lists})
        except (TypeError, KeyError, AttributeError, OverflowError) as error:
            raise ValueError(
                f"expected a fault with kind and cells, got {str(d)[:60]} ({error})"
            ) from None


_NONE = type(None)
_KINDS: Mapping[str, tuple[type, ...]] = {
    "kind": (str,),
    "cells": (list, tuple),
    "line": (dict, _NONE),
    "value": (int, float, _NONE),
    "onset": (int, _NONE),
    "probability": (int, float, _NONE),
    "reason": (str, _NONE),
    "evidence": (int, _NONE),
    "alternatives": (list, tuple, _NONE),
    "recordings": (list, tuple, _NONE),
}


@dataclass(frozen=True, eq=False)
class FaultSet(Set[int]):
    """The paper's F (Section IV): the cells whose values must not be used, out of ``n_cells``.

    Behaves as a set (``in``, ``len``, iteration in ascending order, ``| & - ==``). ``cells`` may be
    a mask, bool ``[D]``.

    Raises:
        ValueError: a cell that is not a whole number from 0 to ``n_cells - 1``; sets over different
            arrays combined.
    """

    cells: tuple[int, ...]
    n_cells: int

    def __post_init__(self) -> None:
        if (
            isinstance(self.n_cells, bool)
            or not isinstance(self.n_cells, int | np.integer)
            or self.n_cells < 0
        ):
            raise ValueError(
                f"F needs the number of cells, a whole number >= 0; got {self.n_cells!r}"
            )
        cells = np.asarray(list(self.cells))
        if cells.size and cells.dtype == bool:
            if cells.size != self.n_cells:
                raise ValueError(f"F is a mask of {cells.size} cells, expected {self.n_cells}")
            cells = np.flatnonzero(cells)
        cells = np.unique(cells)
        if cells.size and not np.issubdtype(cells.dtype, np.integer):
            raise ValueError(f"F holds cell indices, whole numbers; got {self.cells!r}")
        if cells.size and (cells[0] < 0 or cells[-1] >= self.n_cells):
            stray = cells[0] if cells[0] < 0 else cells[-1]
            raise ValueError(
                f"F names cell {stray}, but there are {self.n_cells} cells, numbered 0 to"
                f" {self.n_cells - 1}"
            )
        object.__setattr__(self, "cells", tuple(cells.tolist()))
        object.__setattr__(self, "n_cells", int(self.n_cells))

    @classmethod
    def of(cls, cells: Cells, n_cells: int) -> FaultSet:
        """Return F over ``n_cells`` cells from a fault set, a mask, bool ``[D]``, or any list of
        cells.

        Raises:
            ValueError: a fault set or a mask over another number of cells, or what is no cell of
                the array.
        """
        if isinstance(cells, FaultSet):
            if cells.n_cells != n_cells:
                raise ValueError(f"F is over {cells.n_cells} cells, expected one over {n_cells}")
            return cells
        if not isinstance(cells, Iterable) or isinstance(cells, str | bytes | Mapping):
            raise ValueError(
                f"F is a fault set, a list of cells or a mask, got {str(cells)[:60]!r}"
            )
        return cls(tuple(cells), n_cells)

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """bool ``[D]``, True on the faulty cells."""
        mask = np.zeros(self.n_cells, bool)
        mask[list(self.cells)] = True
        mask.setflags(write=False)
        return mask

    @cached_property
    def healthy(self) -> NDArray[np.intp]:
        """The other cells, int ``[D - k]``, ascending: what the selector phi of Section IV
        keeps."""
        return np.flatnonzero(~self.mask)

    def __contains__(self, cell: object) -> bool:
        return (
            isinstance(cell, int | np.integer)
            and 0 <= int(cell) < self.n_cells
            and bool(self.mask[int(cell)])
        )

    def __iter__(self) -> Iterator[int]:
        return iter(self.cells)

    def __len__(self) -> int:
        return len(self.cells)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, FaultSet):
            return self.n_cells == other.n_cells and self.cells == other.cells
        return Set.__eq__(self, other) if isinstance(other, Set) else NotImplemented

    def __hash__(self) -> int:
        return self._hash()

    def _from_iterable(self, cells: Iterable[int]) -> FaultSet:  # type: ignore[override]  # how Set builds | & - ^
        return FaultSet(tuple(cells), self.n_cells)

    def __or__(self, other: Iterable[int]) -> FaultSet:  # type: ignore[override]
        return self._from_iterable({*self, *self._same_array(other)})

    def __and__(self, other: Iterable[object]) -> FaultSet:
        return self._from_iterable(set(self).intersection(self._same_array(other)))

    def __sub__(self, other: Iterable[Any]) -> FaultSet:
        return self._from_iterable(set(self).difference(self._same_array(other)))

    def _same_array(self, other: Iterable[Any]) -> Iterable[Any]:
        if isinstance(other, FaultSet) and other.n_cells != self.n_cells:
            raise ValueError(
                f"fault sets of arrays with {self.n_cells} and {other.n_cells} cells cannot be"
                " combined"
            )
        return other


Cells: TypeAlias = FaultSet | Iterable[int]
"""F, wherever one is taken: a fault set, any list of cells, or a mask, bool ``[D]``."""
