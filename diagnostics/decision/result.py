"""Result of a diagnosis: a verdict for each cell, the root causes, the fault set F, and the
coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.coverage import Coverage, coverage
from diagnostics.decision.numbering import Numbering
from diagnostics.decision.static_load import StaticLoad
from diagnostics.faults import Fault, FaultSet
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.transport import TransportFault
from diagnostics.shown import shown

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SCHEMA = "adaptfault.diagnosis/1"

_SURE = 0.95


class Verdict(IntEnum):
    """Verdict on one cell. UNTESTED is neither healthy nor faulty: no event of the log, or none of
    its later half, tested the cell."""

    ALIVE = 0
    FAULTY = 1
    UNTESTED = 2

    def __str__(self) -> str:
        return self.name


_OF_VERDICT = "AFU"  # letters of the verdicts in a stored diagnosis


@dataclass(frozen=True, eq=False)
class RecordingVerdicts:
    """The verdicts of a log by recording.

    Attributes:
        verdicts: array ``[n_recordings, D]`` of :class:`Verdict`. A cell that does not move in a
            recording is UNTESTED there, unless it is faulty.
        probability: float ``[n_recordings, D]``, P(cell is faulty in the recording).
        names: of the recordings.
    """

    verdicts: NDArray[np.object_]
    probability: NDArray[np.float64]
    names: tuple[str, ...]


@shown
@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The result of a self-diagnosis.

    Attributes:
        layout: the array.
        faults: one for each root cause: a broken row is one fault with many cells.
        probability: float ``[D]``, P(cell is faulty); 0 where the layout has no cell.
        tested: bool ``[D]``, the log tested whether the cell works.
        n_frames: number of frames in the log.
        n_recordings: number of recordings in the log.
        possible: wires and cells that are more likely faulty than not, but not proven. Their cells
            are in F only as faults of their own.
        static_loads: objects that lie still on the array. Their cells are UNTESTED.
        transport: lost frames, frozen streams and invalid readings: faults of the link, not of
            cells.
        evidence: float ``[D]`` each: ``"spatial"`` and, in a cold start, ``"temporal"``, log
            likelihood ratios faulty : healthy (0: no evidence), and ``"events"``, number of
            events that tested the cell. Evidence of wires is in ``faults``.
        states: uint8 ``[n_recordings, D]``, the verdict of each cell in each recording; None: all
            recordings have that of the log. :attr:`by_recording` tells them.
        names: of the recordings; empty: they are numbered from 0.
    """

    layout: SensorLayout
    faults: tuple[Fault, ...]
    probability: NDArray[np.float64]
    tested: NDArray[np.bool_]
    n_frames: int
    n_recordings: int
    transport: tuple[TransportFault, ...] = ()
    evidence: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    possible: tuple[Fault, ...] = ()
    static_loads: tuple[StaticLoad, ...] = ()
    contradicting: float = 0.0
    states: NDArray[np.uint8] | None = None
    names: tuple[str, ...] = ()

    @classmethod
    def untold(cls, layout: SensorLayout, lengths: Sequence[int], **told: Any) -> Diagnosis:
        """Return a diagnosis that judges no cell, of recordings of so many frames; ``told``: other
        attributes."""
        nothing = np.zeros(layout.n_cells)
        return cls(layout, (), nothing, nothing > 0, sum(lengths), len(lengths), **told)

    @cached_property
    def fault_set(self) -> FaultSet:
        """F: the cells of all faults; an adapter must not use their readings."""
        return FaultSet.of([c for f in self.faults for c in f.cells], self.layout.n_cells)

    @cached_property
    def false_share(self) -> float:
        """Upper bound (95 %) of the share of healthy cells in F, 0 to 1; 0 where F is empty.

        Each root cause is right with its own probability, independent of the others; a wrong one
        puts all its cells into F wrongly. The bound is the 95 % quantile of the number of wrong
        cells (a Poisson binomial distribution, weighted by the cells of each cause) as a share of
        F. It holds as far as the probabilities are calibrated: faults unlike the injected ones of
        the calibration, and disturbances of the whole array, are outside of it.
        """
        if not self.faults:
            return 0.0
        wrong = np.ones(1)  # probability of 0, 1, ... wrong cells
        for fault in self.faults:
            right = 1.0 if fault.probability is None else fault.probability
            shifted = np.concatenate([np.zeros(len(fault.cells)), wrong])
            wrong = np.concatenate([wrong * right, np.zeros(len(fault.cells))])
            wrong += shifted * (1 - right)
        most = int(np.searchsorted(np.cumsum(wrong), _SURE))
        return min(most / len(self.fault_set), 1.0)

    @property
    def frozen(self) -> tuple[TransportFault, ...]:
        """The times when the stream was frozen."""
        return tuple(fault for fault in self.transport if fault.kind == "frozen")

    @cached_property
    def statically_loaded(self) -> FaultSet:
        """The cells of all static loads: healthy as far as the log tells, but their readings are
        not of contact."""
        return FaultSet.of([c for f in self.static_loads for c in f.cells], self.layout.n_cells)

    @property
    def disturbed(self) -> FaultSet:
        """The statically loaded cells and those beside them, which the edge of an object may
        load."""
        loaded = self.statically_loaded
        return FaultSet.of(self.layout.with_neighbours(loaded.mask), self.layout.n_cells)

    @property
    def n_lost(self) -> int:
        """The number of cells that are faulty, or disturbed by a static load."""
        return len(self.fault_set | self.disturbed)

    def suspects(self, probability: float = 0.02) -> FaultSet:
        """Return F and every tested cell with at least this P(faulty): the cells that a classifier
        should ignore.

        F limits the false discovery rate. For a classifier that imputes cells, losing a healthy
        cell costs little and keeping a faulty one much; ``examples/wrong_fault_set.py`` measures
        both. On real grasps the two costs are equal at a probability of 0.02 for cells that read 0,
        and at 0.001 for full scale.
        """
        likely = self.tested & (self.probability >= probability) & self.layout.is_cell
        return FaultSet.of(likely | self.fault_set.mask, self.layout.n_cells)

    @cached_property
    def verdicts(self) -> NDArray[np.object_]:
        """Array ``[D]`` of :class:`Verdict`. A position without a cell is UNTESTED."""
        code = np.where(self.tested & self.layout.is_cell, Verdict.ALIVE, Verdict.UNTESTED)
        code[self.fault_set.mask] = Verdict.FAULTY
        # Enum members: NumPy would convert them to integers.
        return np.array(list(Verdict), dtype=object)[code]

    @cached_property
    def by_recording(self) -> RecordingVerdicts:
        """The verdicts by recording: in which a fault shows, and which of them tested a cell."""
        n = max(self.n_recordings, 1)
        code = np.tile(self.verdicts.astype(np.uint8), (n, 1))
        if self.states is not None:
            code = self.states
        # works in a recording, but not in another one
        recovers = self.fault_set.mask & (code != Verdict.FAULTY)
        probability = np.where(recovers, 0.0, self.probability)
        names = self.names or tuple(map(str, range(len(code))))
        return RecordingVerdicts(np.array(list(Verdict), dtype=object)[code], probability, names)

    @cached_property
    def coverage(self) -> Coverage:
        """Which cells were tested, which were not, and where to press to test them."""
        return coverage(
            self.verdicts == Verdict.UNTESTED, self.fault_set.mask, self.probability, self.layout
        )

    @property
    def exit_code(self) -> int:
        """0: no fault. 1: single cells, a static load, or frames that were frozen, corrupt or
        shifted, or that show crosstalk. 2: a wire, or a tenth of the cells."""
        few = len(self.fault_set) < 0.1 * self.layout.present.sum()
        if not self.faults:
            frames = {fault.kind for fault in self.transport} - {"lost", "invalid"}
            return 1 if self.static_loads or frames else 0
        return 1 if few and all(f.line is None for f in self.faults) else 2

    def map(self, count_from: int = 0) -> str:
        """Return the verdicts drawn as text, the pads side by side; pads and rows are numbered from
        ``count_from``.

        ``.`` alive, ``?`` untested, O open, S short, K stuck, A alias, I intermittent, N noisy, D
        drift, F floating, L late, C copy, M clamped, W weak.
        """
        signs = np.where(self.verdicts == Verdict.UNTESTED, "?", ".")
        for fault in self.faults:
            signs[list(fault.cells)] = fault.kind.letter
        grid = self.layout.grid(np.where(self.layout.is_cell, signs, " "))
        names = [f"pad {pad + count_from}" for pad in range(self.layout.pads)]
        width = max(2 * self.layout.shape[2] - 1, len(names[-1]))
        lines = ["   ".join(["    ", *(name.ljust(width) for name in names)]).rstrip()]
        for row in range(self.layout.rows):
            cells = [" ".join(grid[pad, row]).ljust(width) for pad in range(self.layout.pads)]
            lines.append("   ".join([f"{row + count_from:4d}", *cells]).rstrip())
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.text()

    def text(self, count_from: int = 0) -> str:
        """Return the number of faulty cells, the map and the causes as text, positions counted from
        ``count_from``."""
        found = (
            f"{len(self.fault_set)} faulty cells" if len(self.fault_set) != 1 else "1 faulty cell"
        )
        reasons = [
            line
            for fault in self.faults
            for line in (fault.reason, *(f"  or {a}" for a in fault.alternatives))
        ]
        reasons += [wire.reason for wire in self.possible] + [
            load.reason for load in self.static_loads
        ]
        reasons += [fault.reason for fault in self.transport if fault.reason not in reasons]
        recordings = "1 recording" if self.n_recordings == 1 else f"{self.n_recordings} recordings"
        frames = "1 frame" if self.n_frames == 1 else f"{self.n_frames} frames"
        head = f"{found} in {recordings} ({frames}); {self.coverage}"
        numbering = Numbering.from_layout(self.layout, count_from)
        return "\n".join([head, self.map(count_from), *map(numbering.text, reasons)])

    def to_dataframe(self) -> pd.DataFrame:
        """Return a pandas DataFrame with a row a cell, in their order.

        Columns: ``cell``, ``pad``, ``row``, ``column``, ``verdict`` ("ALIVE", "FAULTY",
        "UNTESTED"), ``probability`` of a fault, ``kind`` of the fault and ``line``, the wire
        behind it; both are empty where there is none. A layout of several axes adds ``axis``.
        Positions without a cell are left out.
        """
        import pandas as pd

        kind = np.full(self.layout.n_cells, "", dtype=object)
        line = kind.copy()
        for fault in self.faults:
            kind[list(fault.cells)] = str(fault.kind)
            if fault.line is not None:
                line[list(fault.cells)] = str(fault.line)
        cells = np.flatnonzero(self.layout.is_cell)
        places = [self.layout.position(cell) for cell in cells.tolist()]
        pad, row, column = zip(*places, strict=True)
        axis = {"axis": cells % self.layout.axes} if self.layout.axes > 1 else {}
        return pd.DataFrame(
            {
                "cell": cells,
                "pad": pad,
                "row": row,
                "column": column,
                **axis,
                "verdict": [verdict.name for verdict in self.verdicts[cells]],
                "probability": self.probability[cells],
                "kind": kind[cells],
                "line": line[cells],
            }
        )

    def plot(self, page: float = 10.0, count_from: int = 0) -> Figure:
        """Return the verdict map as a matplotlib Figure; pads that do not fit ``page`` inches side
        by side go below. Pads, rows and columns are numbered from ``count_from``."""
        from diagnostics.decision.plot import draw

        return draw(self.layout, self.verdicts, self.faults, page, count_from)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict (no NaN) that :meth:`from_dict` reads."""
        return {
            "schema": SCHEMA,
            "layout": self.layout.to_dict(),
            "fault_set": list(self.fault_set),
            "faults": [fault.to_dict() for fault in self.faults],
            "possible": [fault.to_dict() for fault in self.possible],
            "verdicts": [v.name for v in self.verdicts],
            "probability": self.probability.tolist(),
            "evidence": {kind: values.tolist() for kind, values in self.evidence.items()},
            "static_loads": [load.to_dict() for load in self.static_loads],
            "contradicting": self.contradicting,
            "transport": [fault.to_dict() for fault in self.transport],
            "n_frames": self.n_frames,
            "n_recordings": self.n_recordings,
            "by_recording": self._recordings_as_text(),
            "coverage": {
                **asdict(self.coverage),
                "untested": self.coverage.untested.tolist(),
                "advice": list(self.coverage.advice),
            },
        }

    def _recordings_as_text(self) -> dict[str, Any] | None:
        """Return the verdicts by recording, a letter a cell; None where they are not known."""
        if self.states is None:
            return None
        letters = ["".join(_OF_VERDICT[code] for code in row) for row in self.states.tolist()]
        return {"names": list(self.by_recording.names), "verdicts": letters}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Diagnosis:
        """Rebuild a diagnosis from :meth:`to_dict`.

        Raises:
            ValueError: not a diagnosis, one of another version, or one with fields of a wrong kind
                or size.
        """
        if not isinstance(d, Mapping) or d.get("schema") != SCHEMA:
            found = repr(d.get("schema")) if isinstance(d, Mapping) else str(d)[:60]
            raise ValueError(f"expected a diagnosis with schema {SCHEMA!r}, got {found}")
        try:
            diagnosis = cls(
                layout=SensorLayout.from_dict(d["layout"]),
                faults=tuple(Fault.from_dict(f) for f in d["faults"]),
                probability=np.asarray(d["probability"], dtype=np.float64),
                tested=np.asarray([v != Verdict.UNTESTED.name for v in d["verdicts"]]),
                n_frames=d["n_frames"],
                n_recordings=d["n_recordings"],
                evidence={
                    kind: np.asarray(values, dtype=np.float64)
                    for kind, values in d.get("evidence", {}).items()
                },
                transport=tuple(TransportFault.from_dict(f) for f in d.get("transport", ())),
                possible=tuple(Fault.from_dict(f) for f in d.get("possible", ())),
                static_loads=tuple(
                    StaticLoad.from_dict(load) for load in d.get("static_loads", ())
                ),
                contradicting=float(d.get("contradicting", 0.0)),
                **_recordings_of(d.get("by_recording"), len(d["verdicts"])),
            )
        except (KeyError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(f"the diagnosis is damaged: {type(error).__name__} {error}") from None
        diagnosis._check()
        return diagnosis

    def _check(self) -> None:
        """Raise ValueError where a stored diagnosis does not fit together."""
        size = (self.layout.n_cells,)
        vectors = {"probability": self.probability, "verdicts": self.tested, **self.evidence}
        wrong = [
            f"{name} has shape {list(vector.shape)}, expected {list(size)}"
            for name, vector in vectors.items()
            if vector.shape != size
        ]
        fits = {
            "a probability is not between 0 and 1": (
                (self.probability >= 0) & (self.probability <= 1)
            ).all(),
            "n_frames and n_recordings must be whole numbers >= 0": all(
                isinstance(n, int) and n >= 0 for n in (self.n_frames, self.n_recordings)
            ),
            "a transport fault needs a kind and a reason": all(
                isinstance(t.reason, str) and isinstance(t.kind, str) for t in self.transport
            ),
            "evidence must be finite": all(np.isfinite(of).all() for of in self.evidence.values()),
        }
        wrong += [what for what, is_right in fits.items() if not is_right]
        if wrong:
            raise ValueError(f"the diagnosis is damaged: {wrong[0]}")
        _ = self.statically_loaded, self.fault_set  # raise ValueError for cells of another layout


def _recordings_of(about: Mapping[str, Any] | None, n_cells: int) -> dict[str, Any]:
    """Return verdicts by recording and names of a stored diagnosis; empty where it has none.

    Raises:
        ValueError: letters of other verdicts, or of another number of cells.
    """
    if about is None:
        return {}
    code = [[_OF_VERDICT.find(letter) for letter in row] for row in about["verdicts"]]
    if any(len(row) != n_cells or -1 in row for row in code):
        raise ValueError("the diagnosis is damaged: verdicts by recording do not fit the cells")
    states = np.array(code, dtype=np.uint8).reshape(-1, n_cells)
    return {"states": states, "names": tuple(map(str, about["names"]))}
