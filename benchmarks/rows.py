"""The rows of the benchmark: each injects known faults into healthy logs and counts what the
diagnosis says of them.

Half of an array's recordings are the reference, from which :class:`SelfDiagnosis` learns what
healthy looks like. A log is six recordings of the other half. A faulty cell is *testable* if its
true reading differs from what it reads by more than 5 % of full scale in at least 10 frames of the
log.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import combinations

import numpy as np
from own_method import Found, OwnMethod
from sklearn.ensemble import ExtraTreesClassifier

from adaptfault.bench.changes import (
    STUCK_KINDS,
    TESTABLE,
    VISIBLE,
    Log,
    broken,
    differs,
    faults_of,
    held,
    parted,
)
from adaptfault.data.recordings import Recordings
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    Line,
    Monitor,
    SelfDiagnosis,
    SensorLayout,
    Verdict,
    inject,
    line_fault,
    lose_frames,
)
from diagnostics.sensor.recalibration import find_recalibration
from diagnostics.sensor.sensor_change import pad_change
from diagnostics.simulation.circuit import Circuit, StuckCell

WINDOW = 50  # frames in which a cell can raise a false alarm
REPEATED = 100  # frames of a frozen stream, beyond the longest repetition that still counts as idle
CHANGING = (FaultKind.INTERMITTENT, FaultKind.NOISY, FaultKind.DRIFT)
# times the load; what is left at the end
GAINS = (0.2, 0.35, 0.5)
FADED = 0.1
UNDER = 20  # recordings of a log in which an object lies still
SPECIMEN = 48  # recordings from which a new specimen is learned
REPLACED = 12  # recordings with a new specimen of a pad
# recordings of a log that shows a gain; in so many of them the cell is loaded
LONG = 30
LOADED = 8
IN_USE = 40  # recordings of a log in which dead cells move
MOVING_SHARE = 0.08  # share of its cells that are dead
USED = 3  # recordings that load a cell: then the log tests it
DOUBTED = 0.1  # P(faulty) below which a cell counts as called alive
WORN = 0.35  # of its load that a patch reads at the end of a log
DEAD_BEFORE = 0.04  # share of the cells that were dead when the reference was recorded


@dataclass(frozen=True)
class Count:
    """One figure: ``of`` cases, ``part`` of them; ``unit``: how the ratio reads; ``higher``:
    whether more is better."""

    row: str
    part: float
    of: float
    unit: str = ""
    higher: bool = True


@dataclass
class Tally:
    """What was found of the dead cells of some logs."""

    true: int = 0
    false: int = 0
    testable: int = 0
    hit: int = 0
    right_kind: int = 0
    objects: int = 0  # static loads in logs without one
    # observable frames between the true and the reported onset
    late: list[int] = field(default_factory=list)
    probability: list[np.ndarray] = field(default_factory=list)
    dead: list[np.ndarray] = field(default_factory=list)

    def add(
        self, log: Log, seen: Log, faults: Sequence[Fault], diagnosis: Diagnosis | Found, start: int
    ) -> None:
        """Count one log: true readings, readings with the faults, and the diagnosis; ``start``: the
        onset."""
        layout = diagnosis.layout
        found = diagnosis.fault_set
        before = np.concatenate(log)
        after = np.concatenate(seen)
        can = set(np.flatnonzero(differs(before, after, layout).sum(axis=0) >= TESTABLE).tolist())
        kinds = kind_of_cells(faults)
        told = {cell: fault for fault in diagnosis.faults for cell in fault.cells}
        self.true, self.false = (
            self.true + len(found & kinds.keys()),
            self.false + len(found - kinds.keys()),
        )
        self.testable, self.hit = self.testable + len(can), self.hit + len(found & can)
        self.objects += len(diagnosis.static_loads)
        self.right_kind += sum(kinds.get(cell) == fault.kind for cell, fault in told.items())
        for cell in found & can & told.keys():
            between = slice(*sorted((start, told[cell].onset or 0)))
            self.late.append(int(differs(before[between, cell], after[-1, cell], layout).sum()))
        present = layout.present.ravel()
        self.probability.append(diagnosis.probability[present])
        self.dead.append(np.isin(np.flatnonzero(present), list(kinds)))

    def counts(self, case: str) -> Iterator[Count]:
        """Yield precision, and recall of the testable."""
        yield Count(f"{case}: precision", self.true, self.true + self.false)
        yield Count(f"{case}: recall", self.hit, self.testable)


@dataclass
class Bench:
    """The recordings of one array, dealt into reference and rest.

    Attributes:
        split: which half is the reference; repeat: shuffles the reference and draws other logs and
            faults.
        count: logs of a row.
        trained: recordings that the diagnosis learns from in place of ``recordings``: before a
            drift.
        method: ``module:Name`` of a detector under test in place of the diagnosis; "": none.
    """

    recordings: Recordings
    split: int
    count: int
    repeat: int = 0
    trained: Recordings | None = None
    method: str = ""

    def __post_init__(self) -> None:
        self.layout = self.recordings.layout
        order = np.random.default_rng(self.split).permutation(len(self.recordings))
        half = len(order) // 2
        self.reference = order[:half]
        self.rest = order[half:]
        if self.repeat:
            np.random.default_rng(self.repeat).shuffle(self.reference)
        self.case = cache(self._case)

    @cached_property
    def fitted(self) -> SelfDiagnosis | OwnMethod:
        """The diagnosis, or the detector, under test."""
        frames = (self.trained or self.recordings).frames
        made = OwnMethod(self.method, self.layout) if self.method else SelfDiagnosis(self.layout)
        return made.fit([frames[i] for i in self.reference])

    def logs(self, length: int = 6) -> Iterator[tuple[int, Log, np.random.Generator]]:
        """Yield seed, log and a generator for its faults."""
        for seed in range(10_000 * self.repeat, 10_000 * self.repeat + self.count):
            rng = np.random.default_rng(seed)
            drawn = rng.choice(self.rest, min(length, len(self.rest)), replace=False)
            yield (
                seed,
                [np.asarray(self.recordings.frames[i], dtype=np.float64) for i in drawn],
                rng,
            )

    def _case(
        self,
        share: float,
        onset: float = 0.0,
        kinds: tuple[str, ...] = STUCK_KINDS,
        dither: float = 0.0,
        missing: float = 0.0,
        cold: bool = False,
        length: int = 6,
    ) -> Tally:
        tally = Tally()
        diagnoser = SelfDiagnosis(self.layout) if cold else self.fitted
        for seed, log, rng in self.logs(length):
            faults = draw_faults(self.layout, share, kinds, rng)
            seen = list(broken(log, faults, self.layout, onset, dither, seed))
            if missing:
                seen = [
                    np.where(rng.random(frames.shape) < missing, np.nan, frames) for frames in seen
                ]
            tally.add(
                log, seen, faults, diagnoser.diagnose(seen), round(onset * sum(map(len, log)))
            )
        return tally


def draw_faults(
    layout: SensorLayout, share: float, kinds: tuple[str, ...], rng: np.random.Generator
) -> list[Fault]:
    present = np.flatnonzero(layout.present)
    cells = rng.choice(present, round(share * len(present)), replace=False)
    return faults_of(cells, kinds, layout, rng)


def kind_of_cells(faults: Sequence[Fault]) -> dict[int, FaultKind]:
    return {cell: fault.kind for fault in faults for cell in fault.cells}


def cells(bench: Bench) -> Iterator[Count]:
    tally = bench.case(0.16)
    yield from tally.counts("16 % dead")
    yield Count("  static loads told where nothing lies", tally.objects, bench.count, higher=False)


def onset(bench: Bench) -> Iterator[Count]:
    tally = bench.case(0.16, onset=0.6)
    yield from tally.counts("16 % dead from 60 % of the log on")
    yield Count("  its onset, mean error", sum(tally.late), len(tally.late), "frames", higher=False)


def dither(bench: Bench) -> Iterator[Count]:
    yield from bench.case(0.16, kinds=("stuck",), dither=0.004).counts("mid-range, dither 0.4 %")


def missing(bench: Bench) -> Iterator[Count]:
    yield from bench.case(0.16, missing=0.3).counts("16 % dead, 30 % of the readings missing")


def many(bench: Bench) -> Iterator[Count]:
    for share in (0.4, 1.0):
        yield from bench.case(share).counts(f"{share:.0%} dead".replace("%", " %"))


def cold(bench: Bench) -> Iterator[Count]:
    """Without a reference."""
    yield from bench.case(0.16, cold=True).counts("no reference, 16 % dead")
    diagnoser = SelfDiagnosis(bench.layout)
    false = 0
    windows = 0
    for _, log, _ in bench.logs():
        false = false + len(diagnoser.diagnose(log).fault_set)
        windows = windows + windows_of(log, bench.layout)
    yield Count(
        "no reference, healthy: false alarms", 1e6 * false, windows, "in 1e6 windows", higher=False
    )


def own_reference(bench: Bench) -> Iterator[Count]:
    """Long logs without a reference: dead from the start, from some frame on, and healthy."""
    for onset, since in (
        (0.0, ""),
        (0.3, " from 30 % of the log on"),
        (0.6, " from 60 % of the log on"),
    ):
        tally = bench.case(MOVING_SHARE, onset, cold=True, length=IN_USE)
        yield from tally.counts(f"no reference, 40 recordings, 8 % dead{since}")
    diagnoser = SelfDiagnosis(bench.layout)
    blamed = sum(len(diagnoser.diagnose(log).fault_set) for _, log, _ in bench.logs(IN_USE))
    yield Count(
        "no reference, 40 recordings, healthy: cells blamed in a log",
        blamed,
        bench.count,
        higher=False,
    )


def reference_faults(bench: Bench) -> Iterator[Count]:
    """Cells that were dead already when the reference was recorded."""
    layout = bench.layout
    rng = np.random.default_rng(1000 + bench.repeat)
    faults = draw_faults(layout, DEAD_BEFORE, STUCK_KINDS, rng)
    cells = [cell for fault in faults for cell in fault.cells]
    frames = [np.asarray(bench.recordings.frames[i], dtype=np.float64) for i in bench.reference]
    fitted = SelfDiagnosis(layout).fit(
        [inject(f, faults, layout, seed=i) for i, f in enumerate(frames)]
    )
    hidden = differs(
        np.concatenate(frames), inject(np.concatenate(frames), faults, layout), layout
    ).sum(axis=0)
    testable = [cell for cell in cells if hidden[cell] >= TESTABLE]
    assert fitted.reference_ is not None
    known = np.flatnonzero(fitted.reference_.dead > 0)
    yield Count(
        "4 % dead in the reference: found", len(np.intersect1d(known, testable)), len(testable)
    )
    false = true = windows = 0
    for seed, log, _ in bench.logs():
        seen = list(broken(log, faults, layout, 0.0, 0.0, seed))
        found = fitted.diagnose(seen).fault_set
        false = false + len(found - set(cells))
        true = true + len(found & set(cells))
        windows += windows_of(log, layout)
    yield Count(
        "4 % dead in the reference: false alarms",
        1e6 * false,
        windows,
        "in 1e6 windows",
        higher=False,
    )


def wires(layout: SensorLayout) -> list[Line]:
    return [
        line
        for line in layout.lines
        if line.kind in ("row", "column") and len(layout.cells_on(line)) > 2
    ]


def lines(bench: Bench) -> Iterator[Count]:
    layout = bench.layout
    exact = []
    held = []
    invented = 0
    doubtful = 0
    for seed, log, rng in bench.logs():
        choice = wires(layout)
        while True:
            a, b = (choice[i] for i in rng.choice(len(choice), 2, replace=False))
            if a.pad != b.pad or a.kind == b.kind:  # they do not cross
                break
        kinds = rng.choice([FaultKind.OPEN, FaultKind.SHORT], 2)
        on_lines = [
            line_fault(layout, line, FaultKind(kind))
            for line, kind in zip((a, b), kinds, strict=True)
        ]
        behind = {cell for fault in on_lines for cell in fault.cells}
        single = [
            fault
            for fault in draw_faults(layout, 0.04, STUCK_KINDS, rng)
            if behind.isdisjoint(fault.cells)
        ]
        seen = list(broken(log, on_lines + single, layout, 0.0, 0.0, seed))
        testable = (
            differs(np.concatenate(log), np.concatenate(seen), layout).sum(axis=0) >= TESTABLE
        )
        diagnosis = bench.fitted.diagnose(seen)
        true = {(fault.line, fault.kind) for fault in on_lines}
        found = {(f.line, f.kind) for f in diagnosis.faults if f.line is not None}
        possible = {(f.line, f.kind) for f in diagnosis.possible}
        invented = invented + len(found - true)
        doubtful = doubtful + len(possible - true)
        if all(testable[list(f.cells)].sum() >= 3 for f in on_lines if f.kind is FaultKind.OPEN):
            exact.append(found == true)
            held.append(found <= true <= found | possible)
    yield Count("2 broken lines + 4 % of the cells: exact lines", sum(exact), len(exact))
    yield Count("  exact, or what is missing is possible", sum(held), len(held))
    yield Count("  lines invented in a log", invented, bench.count, higher=False)
    yield Count(
        "  possible lines in a log that are not broken", doubtful, bench.count, higher=False
    )


def groups(bench: Bench) -> Iterator[Count]:
    """Two dead buses or groups, inner or outer ones, and single cells: are they named, and nothing
    else?"""
    layout = bench.layout
    named = 0
    asked = 0
    invented = 0
    healthy = 0
    sets = {line: set(layout.cells_on(line).tolist()) for line in layout.lines}
    for seed, log, rng in bench.logs():
        healthy += sum(fault.line is not None for fault in bench.fitted.diagnose(log).faults)
        first = layout.lines[rng.integers(len(layout.lines))]
        choice = [line for line in layout.lines if sets[line].isdisjoint(sets[first])]
        dead = [first, choice[rng.integers(len(choice))]]
        behind = sets[dead[0]] | sets[dead[1]]
        whole = {line for line in layout.lines if sets[line] <= behind}
        faults = [
            fault
            for fault in draw_faults(layout, 0.04, STUCK_KINDS, rng)
            if behind.isdisjoint(fault.cells)
        ]
        seen = list(broken(log, faults, layout, 0.0, 0.0, seed))
        for line in dead:
            silent = rng.random() < 0.5
            value = np.nan if silent else layout.full_scale * rng.integers(2)
            for frames in seen:
                frames[:, layout.cells_on(line)] = value
        touched = differs(np.concatenate(log), np.concatenate(seen), layout).sum(axis=0) >= TESTABLE
        found = {
            fault.line for fault in bench.fitted.diagnose(seen).faults if fault.line is not None
        }
        for line in dead:
            unread = np.isnan(seen[0][:, layout.cells_on(line)]).all()
            if unread or touched[layout.cells_on(line)].sum() >= 3:
                asked = asked + 1
                named = named + (line in found)
        invented += len(found - whole)
    yield Count("2 dead groups + 4 % of the cells: named", named, asked)
    yield Count("  other groups named in a log", invented, bench.count, higher=False)
    yield Count("  groups named in a healthy log", healthy, bench.count, higher=False)


def cut(bench: Bench) -> Iterator[Count]:
    layout = bench.layout
    exact = 0
    asked = 0
    for seed, log, rng in bench.logs():
        touched = (
            differs(np.concatenate(log), np.zeros(layout.n_cells), layout).sum(axis=0) >= TESTABLE
        )
        choice = []
        for line in wires(layout):
            across = 2 if line.kind == "row" else 1
            on_line = layout.cells_on(line)
            place = [layout.position(cell)[across] for cell in on_line.tolist()]
            for i in range(1, len(on_line)):
                # Both cells beside the break were loaded, and another one behind it.
                if touched[on_line[[i - 1, i]]].all():
                    if touched[on_line[i:]].sum() >= 2:
                        choice.append((line, place[i], "first"))
                    if touched[on_line[:i]].sum() >= 2:
                        choice.append((line, place[i - 1] + 1, "last"))
        if choice:
            line, at, end = choice[rng.integers(len(choice))]
            fault = line_fault(layout, line, FaultKind.OPEN, break_at=at, driven_from=end)
            found = bench.fitted.diagnose(list(broken(log, [fault], layout, 0.0, 0.0, seed))).faults
            asked = asked + 1
            exact = exact + any(f.line == line and f.cells == fault.cells for f in found)
    yield Count("a break inside a line: exact position", exact, asked)


def address(bench: Bench) -> Iterator[Count]:
    layout = bench.layout
    asked = 0
    right = 0
    blamed = 0
    choice = [line for line in layout.lines if line.kind in ("row_address", "column_address")]
    for seed, log, rng in bench.logs():
        line = choice[rng.integers(len(choice))]
        level = int(rng.integers(2))
        fault = line_fault(layout, line, FaultKind.ALIAS, value=level)
        seen = list(broken(log, [fault], layout, 0.0, 0.0, seed))
        if differs(np.concatenate(log), np.concatenate(seen), layout).any(axis=1).sum() < TESTABLE:
            continue
        diagnosis = bench.fitted.diagnose(seen)
        asked += 1
        right += any(
            f.kind is FaultKind.ALIAS and f.line == line and f.value == level
            for f in diagnosis.faults
        )
        blamed += len(diagnosis.fault_set - set(fault.cells))
    yield Count("stuck address bit: bit and level named", right, asked)
    yield Count("  other cells blamed in a log", blamed, asked, higher=False)


def windows_of(log: Log, layout: SensorLayout) -> int:
    """Return in how many windows a cell could raise a false alarm."""
    return round(layout.present.sum() * sum(map(len, log)) / WINDOW)


def healthy(bench: Bench) -> Iterator[Count]:
    false = windows = possible = 0
    for _, log, _ in bench.logs():
        diagnosis = bench.fitted.diagnose(log)
        false = false + len(diagnosis.fault_set)
        windows = windows + windows_of(log, bench.layout)
        possible += len(diagnosis.possible)
    yield Count("healthy: false alarms", 1e6 * false, windows, "in 1e6 windows", higher=False)
    yield Count("  possible lines in a log", possible, bench.count, higher=False)


def holds(bench: Bench) -> Iterator[Count]:
    false = windows = 0
    for _, log, rng in bench.logs():
        seen = [held(frames, rng, bench.layout.full_scale) for frames in log]
        false = false + len(bench.fitted.diagnose(seen).fault_set)
        windows = windows + windows_of(seen, bench.layout)
    yield Count("healthy, held: false alarms", 1e6 * false, windows, "in 1e6 windows", higher=False)


def untouched(bench: Bench) -> Iterator[Count]:
    asked = wrong = 0
    for _, log, _ in bench.logs():
        never = (np.ptp(np.concatenate(log), axis=0) == 0) & bench.layout.present.ravel()
        asked += int(never.sum())
        wrong += int((bench.fitted.diagnose(log).verdicts[never] != Verdict.UNTESTED).sum())
    yield Count("cells that never moved, healthy: not UNTESTED", wrong, asked, higher=False)


def kind(bench: Bench) -> Iterator[Count]:
    tallies = [bench.case(0.16), bench.case(0.16, onset=0.6)]
    yield Count(
        "kind of fault right", sum(t.right_kind for t in tallies), sum(t.true for t in tallies)
    )


def calibration(bench: Bench) -> Iterator[Count]:
    tallies = [bench.case(0.16), bench.case(0.16, onset=0.6)]
    p, y = (
        np.concatenate([x for t in tallies for x in getattr(t, name)])
        for name in ("probability", "dead")
    )
    where = np.minimum((10 * p).astype(int), 9)
    error = sum(abs(p[where == b].sum() - y[where == b].sum()) for b in range(10))
    yield Count("P(faulty): calibration error", error, len(p), higher=False)


def changing(bench: Bench) -> Iterator[Count]:
    layout = bench.layout
    drawn = Counter()
    right = Counter()
    false = 0
    for seed, log, rng in bench.logs():
        whole = np.concatenate(log)
        loaded = np.flatnonzero((whole > VISIBLE * layout.full_scale).sum(axis=0) > 40)
        chosen = rng.permutation(loaded)[: 3 * len(CHANGING)].tolist()
        faults = [Fault(CHANGING[i % len(CHANGING)], (cell,)) for i, cell in enumerate(chosen)]
        # In one piece: a drift goes on from recording to recording.
        diagnosis = bench.fitted.diagnose(parted(inject(whole, faults, layout, seed=seed), log))
        told = kind_of_cells(diagnosis.faults)
        for fault in faults:
            drawn[fault.kind] += 1
            right[fault.kind] += told.get(fault.cells[0]) is fault.kind
        false += len(diagnosis.fault_set - set(chosen))
    for k in CHANGING:
        yield Count(f"{k}: found and named", right[k], drawn[k])
    yield Count("  other cells blamed in a log", false, bench.count, higher=False)


def gain(bench: Bench) -> Iterator[Count]:
    """One contact says little of a gain: these logs are longer."""
    layout = bench.layout
    drawn = Counter()
    named = Counter()
    false = 0
    for _, log, rng in bench.logs(LONG):
        whole = np.concatenate(log)
        loaded = sum(
            (frames > VISIBLE * layout.full_scale).any(axis=0).astype(int) for frames in log
        )
        chosen = rng.permutation(np.flatnonzero(loaded >= LOADED)).tolist()
        lasts = len(whole) / layout.rate  # seconds
        fading = [Fault(FaultKind.DRIFT, (cell,), value=0.0) for cell in chosen[:1]]
        seen = inject(whole, fading, layout, gain=(FADED - 1) / lasts)
        cases = dict(
            zip(chosen, (f"gain fades to {FADED}", *(f"gain {g}" for g in GAINS)), strict=False)
        )
        for cell, times in zip(chosen[1:], GAINS, strict=False):
            seen[:, cell] *= times
        diagnosis = bench.fitted.diagnose(parted(seen, log))
        told = kind_of_cells(diagnosis.faults)
        for cell, case in cases.items():
            drawn[case] += 1
            named[case] += told.get(cell) in (FaultKind.DRIFT, FaultKind.WEAK)
        false += len(diagnosis.fault_set - set(cases))
    for case in sorted(drawn):
        yield Count(f"{case}: found and named", named[case], drawn[case])
    yield Count("  other cells blamed in a log", false, bench.count, higher=False)


def wirings(layout: SensorLayout) -> dict[str, list[np.ndarray]]:
    """Return by kind the changed wirings of an array: index i reads cell ``wiring[i]``."""
    grid = layout.grid(np.arange(layout.n_cells))
    found: dict[str, list[np.ndarray]] = {}

    def add(kind: str, pad: int, axis: int, order: np.ndarray) -> None:
        changed = grid.copy()
        changed[pad] = np.take(grid[pad], order, axis=axis)
        found.setdefault(kind, []).append(changed.ravel())

    for pad in range(layout.pads):
        for axis, size in enumerate(layout.shape[1:]):
            for pair in combinations(range(size), 2):
                order = np.arange(size)
                order[list(pair)] = order[list(pair[::-1])]
                add("two lines exchanged", pad, axis, order)
            if size > 3:
                add("a pad mirrored", pad, axis, np.arange(size)[::-1])
                for by in (1, -1):
                    add("lines shifted by one", pad, axis, np.roll(np.arange(size), by))
    for a, b in combinations(range(layout.pads), 2):
        order = np.arange(layout.pads)
        order[[a, b]] = b, a
        found.setdefault("two pads exchanged", []).append(grid[order].ravel())
    return found


def highest(bench: Bench) -> float:
    """Return the highest reading of the reference: the range of sensors that never come near full
    scale."""
    return max(float(np.nanmax(bench.recordings.frames[i])) for i in bench.reference)


def rest_levels(bench: Bench) -> np.ndarray:
    """Return the low quantile of the readings of each cell in the reference, ``[D]``."""
    return np.quantile(
        np.concatenate([bench.recordings.frames[i] for i in bench.reference]), 0.05, axis=0
    )


def per_recording(
    log: Log, fault: Callable[[int], Fault | None], layout: SensorLayout, seed: int
) -> Log:
    """Return the log with another fault, or none, in each recording."""
    seen = []
    for i, frames in enumerate(log):
        found = fault(i)
        seen.append(inject(frames, [] if found is None else [found], layout, seed=seed + i))
    return seen


def in_one_piece(
    log: Log, fault: Fault, layout: SensorLayout, seed: int, dither: float = 0.0
) -> Log:
    """Return the log with a fault that goes on from recording to recording."""
    return parted(inject(np.concatenate(log), [fault], layout, seed=seed, dither=dither), log)


def moving_cases(bench: Bench) -> dict[str, Callable[[Log, Log, int, np.random.Generator], Log]]:
    """Return by name what a dead cell that moves reads: from log, another log, cell and generator
    to the log seen."""
    layout = bench.layout
    span = highest(bench)
    rest = rest_levels(bench)

    def seed_of(rng: np.random.Generator) -> int:
        return int(rng.integers(1 << 30))

    def swings(share: float):
        def case(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
            return in_one_piece(
                log, Fault(FaultKind.FLOATING, (cell,), value=share * span), layout, seed_of(rng)
            )

        return case

    def noise(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        at_rest = in_one_piece(log, Fault(FaultKind.OPEN, (cell,), value=rest[cell]), layout, 0)
        sigma = rng.uniform(0.004, 0.008) * span
        return in_one_piece(
            at_rest, Fault(FaultKind.NOISY, (cell,), value=sigma), layout, seed_of(rng)
        )

    def dead_every(k: int):
        def case(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
            open_at_rest = Fault(FaultKind.OPEN, (cell,), value=rest[cell])
            return per_recording(log, lambda i: open_at_rest if i % k == k - 1 else None, layout, 0)

        return case

    def floats(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        half = 45 / 4095 * span
        fault = Fault(FaultKind.OPEN, (cell,), value=half)
        return in_one_piece(log, fault, layout, seed_of(rng), dither=half / layout.full_scale)

    def late(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        return in_one_piece(log, Fault(FaultKind.LATE, (cell,), value=10), layout, 0)

    def repeats(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        source = int(rng.choice(neighbours(layout, cell)))
        return in_one_piece(log, Fault(FaultKind.COPY, (cell,), value=source), layout, 0)

    def mean_of_neighbours(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        return in_one_piece(log, Fault(FaultKind.COPY, (cell,)), layout, 0)

    def latched(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        levels = rng.uniform(0.0, 0.9, len(log)) * span
        return per_recording(
            log, lambda i: Fault(FaultKind.STUCK, (cell,), value=float(levels[i])), layout, 0
        )

    def clamped(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        fault = Fault(FaultKind.CLAMPED, (cell,), value=rest[cell] + 0.1 * span)
        return in_one_piece(log, fault, layout, 0)

    def keeps_peak(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        seen = [frames.copy() for frames in log]
        for frames in seen:
            frames[:, cell] = np.maximum.accumulate(frames[:, cell])
        return seen

    def of_another(log: Log, other: Log, cell: int, rng: np.random.Generator) -> Log:
        elsewhere = np.concatenate(other)[:, cell]
        whole = np.concatenate(log)
        whole[:, cell] = np.resize(elsewhere, len(whole))
        return parted(whole, log)

    return {
        "swings by 20 %": swings(0.2),
        "swings by 10 %": swings(0.1),
        "swings by 5 %": swings(0.05),
        "noise of 0.4 to 0.8 %": noise,
        "dead in every 2nd recording": dead_every(2),
        "dead in every 3rd recording": dead_every(3),
        "floats by 90 of 4095": floats,
        "10 frames late": late,
        "repeats a neighbour": repeats,
        "mean of the neighbours": mean_of_neighbours,
        "latched at another level": latched,
        "clamped at 10 %": clamped,
        "keeps its peak": keeps_peak,
        "load of another recording": of_another,
    }


def in_use(log: Log, rest: np.ndarray, span: float) -> np.ndarray:
    """Return the cells that at least 3 recordings load, bool ``[D]``."""
    loaded = [(frames - rest > VISIBLE * span).any(axis=0) for frames in log]
    return np.sum(loaded, axis=0) >= USED


def called_alive(diagnosis: Diagnosis | Found) -> np.ndarray:
    """Return the cells that are called alive, bool ``[D]``."""
    return (diagnosis.verdicts == Verdict.ALIVE) & (diagnosis.probability < DOUBTED)


def moving(bench: Bench) -> Iterator[Count]:
    """Dead cells that move; testable is what reads otherwise by more than 5 % of the range in use
    in 10 frames."""
    layout = bench.layout
    span = highest(bench)
    for case, seen_by in moving_cases(bench).items():
        hit = true = false = testable = alive = 0
        for _, log, rng in bench.logs(IN_USE):
            other = [
                np.asarray(bench.recordings.frames[i], dtype=np.float64)
                for i in rng.permutation(bench.rest)
            ]
            present = np.flatnonzero(layout.present)
            dead = rng.choice(present, max(1, round(MOVING_SHARE * len(present))), replace=False)
            seen = [frames.copy() for frames in log]
            for cell in dead.tolist():
                for frames, broke in zip(seen, seen_by(log, other, cell, rng), strict=True):
                    frames[:, cell] = broke[:, cell]
            wrong = np.abs(np.concatenate(seen) - np.concatenate(log)) > VISIBLE * span
            can = np.intersect1d(dead, np.flatnonzero(wrong.sum(axis=0) >= TESTABLE))
            diagnosis = bench.fitted.diagnose(seen)
            found = np.flatnonzero(diagnosis.fault_set.mask)
            testable += len(can)
            hit += len(np.intersect1d(found, can))
            true += len(np.intersect1d(found, dead))
            false += len(np.setdiff1d(found, dead))
            alive += int(called_alive(diagnosis)[can].sum())
        yield Count(f"{case}: recall", hit, testable)
        yield Count(f"{case}: precision", true, true + false)
        yield Count(f"{case}: called alive", alive, testable, higher=False)


def proven(bench: Bench) -> Iterator[Count]:
    """Long healthy logs: who is blamed, and who is shown to be alive of those that are loaded in 3
    recordings."""
    span = highest(bench)
    rest = rest_levels(bench)
    blamed = alive = used = 0
    for _, log, _ in bench.logs(IN_USE):
        tested = in_use(log, rest, span) & bench.layout.present.ravel()
        diagnosis = bench.fitted.diagnose(log)
        blamed += len(diagnosis.fault_set)
        used += int(tested.sum())
        alive += int((diagnosis.verdicts[tested] == Verdict.ALIVE).sum())
    yield Count("healthy, 40 recordings: cells blamed in a log", blamed, bench.count, higher=False)
    yield Count("  alive of the cells in use", alive, used)


def failing_cases() -> dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]]:
    """Return by name in which frames ``[T]`` a wire fails, of the loads ``[T]`` of its pad."""

    def under_load(load: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return load > np.quantile(load[load > 0], rng.choice([0.3, 0.5, 0.7]))

    def flickers(load: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        lengths = rng.integers(5, 60, len(load))
        fails = rng.random(len(load)) < 0.4
        return np.repeat(fails, lengths)[: len(load)]

    return {"opens under load": under_load, "flickers": flickers}


def failing(bench: Bench) -> Iterator[Count]:
    """A row or column that fails now and then, of which at least 3 cells are loaded in 3
    recordings: is it named?"""
    layout = bench.layout
    span = highest(bench)
    rest = rest_levels(bench)
    for case, fails in failing_cases().items():
        named = logs = blamed = alive = cells = 0
        for _, log, rng in bench.logs(IN_USE):
            used = in_use(log, rest, span)
            choice = [line for line in wires(layout) if used[list(layout.cells_on(line))].sum() > 2]
            if not choice:
                continue
            line = choice[rng.integers(len(choice))]
            of_wire = np.asarray(layout.cells_on(line))
            whole = np.concatenate(log)
            load = np.maximum(whole - rest, 0)[:, layout.pad_of == line.pad].sum(axis=1)
            gone = fails(load, rng)
            seen = whole.copy()
            seen[np.ix_(gone, of_wire)] = rest[of_wire]
            diagnosis = bench.fitted.diagnose(parted(seen, log))
            wrong = np.abs(seen - whole)[:, of_wire] > VISIBLE * span
            can = of_wire[wrong.sum(axis=0) >= TESTABLE]
            logs += 1
            named += any(fault.line == line for fault in diagnosis.faults)
            blamed += len(set(diagnosis.fault_set) - set(of_wire.tolist()))
            alive += int(called_alive(diagnosis)[can].sum())
            cells += len(can)
        yield Count(f"a wire {case}: named", named, logs)
        yield Count(f"a wire {case}: healthy cells blamed in a log", blamed, logs, higher=False)
        yield Count(f"a wire {case}: its cells called alive", alive, cells, higher=False)


def crossing(bench: Bench) -> Iterator[Count]:
    """The layers of a loaded cell touch: on a grounded read-out it reads full scale, and the rest
    of its row and its column a part of their load."""
    layout = bench.layout
    span = highest(bench)
    rest = rest_levels(bench)
    healthy = Circuit(layout)
    logs = found = blamed = alive = moved = 0
    for _, log, rng in bench.logs(IN_USE):
        whole = np.concatenate(log)
        used = np.flatnonzero(in_use(log, rest, span) & layout.present.ravel())
        if not len(used):
            continue
        cell = int(rng.choice(used))
        load = np.clip(whole - rest, 0, None)
        shorted = healthy.with_faults(StuckCell(cell, 0.0)).read(load)
        seen = whole + shorted - healthy.read(load)
        diagnosis = bench.fitted.diagnose(parted(seen, log))
        wrong = (np.abs(seen - whole) > VISIBLE * span).sum(axis=0) >= TESTABLE
        others = np.setdiff1d(np.flatnonzero(wrong), [cell])
        logs += 1
        found += cell in diagnosis.fault_set
        blamed += len(set(diagnosis.fault_set) - set(np.flatnonzero(wrong).tolist()) - {cell})
        alive += int(called_alive(diagnosis)[others].sum())
        moved += len(others)
    yield Count("a shorted crossing: found", found, logs)
    yield Count(
        "a shorted crossing: cells it leaves alone blamed in a log", blamed, logs, higher=False
    )
    yield Count("a shorted crossing: cells it changes called alive", alive, moved, higher=False)


def worn(bench: Bench) -> Iterator[Count]:
    """A cell and those around it, at least 3 of them in use, fade together to 0.35 of their load
    over a log."""
    layout = bench.layout
    span = highest(bench)
    rest = rest_levels(bench)
    logs = found = blamed = alive = cells = 0
    for _, log, rng in bench.logs(IN_USE):
        used = in_use(log, rest, span)
        patches = [np.array([cell, *neighbours(layout, cell)]) for cell in np.flatnonzero(used)]
        patches = [patch for patch in patches if used[patch].sum() > 2]
        if not patches:
            continue
        patch = patches[rng.integers(len(patches))]
        whole = np.concatenate(log)
        gain = np.linspace(1, WORN, len(whole))[:, None]
        seen = whole.copy()
        seen[:, patch] = rest[patch] + gain * (whole - rest)[:, patch]
        diagnosis = bench.fitted.diagnose(parted(seen, log))
        can = patch[used[patch]]
        logs += 1
        found += len(diagnosis.fault_set & set(can.tolist()))
        blamed += len(set(diagnosis.fault_set) - set(patch.tolist()))
        alive += int(called_alive(diagnosis)[can].sum())
        cells += len(can)
    yield Count("a patch wears to 0.35: found", found, cells)
    yield Count("a patch wears to 0.35: other cells blamed in a log", blamed, logs, higher=False)
    yield Count("a patch wears to 0.35: called alive", alive, cells, higher=False)


def rewired(bench: Bench) -> Iterator[Count]:
    """Wirings that change a visible number of readings; told right: put back as they were."""
    layout, choice = bench.layout, wirings(bench.layout)
    right = Counter()
    told = Counter()
    asked = Counter()
    false = 0
    for _, log, rng in bench.logs():
        whole = np.concatenate(log)
        false += bench.fitted.rewiring(log) is not None
        for case, of_case in choice.items():
            wiring = of_case[rng.integers(len(of_case))]
            if differs(whole[:, wiring], whole, layout).any(axis=1).sum() < TESTABLE:
                continue
            asked[case] += 1
            found = bench.fitted.rewiring([frames[:, wiring] for frames in log])
            if found is not None:
                told[case] += 1
                right[case] += not differs(found.undo(whole[:, wiring]), whole, layout)[
                    :, layout.present.ravel()
                ].any()
    for case in choice:
        yield Count(f"{case}: undone", right[case], asked[case])
    yield Count(
        "changed wiring: undone wrongly",
        sum(told.values()) - sum(right.values()),
        sum(asked.values()),
        "",
        False,
    )
    yield Count("healthy: a changed wiring named in a log", false, bench.count, higher=False)


def replaced(bench: Bench) -> Iterator[Count]:
    """One pad is a new specimen that reads half, or twice, as much; so many recordings show it."""
    layout = bench.layout
    told = 0
    wrong = 0
    healthy = 0
    blamed = 0
    cells = np.flatnonzero(layout.present)
    reference = [np.asarray(bench.recordings.frames[i], dtype=np.float64) for i in bench.reference]
    for _, log, rng in bench.logs(REPLACED):
        healthy += pad_change(log, reference, layout, cells) is not None
        pad = int(rng.integers(layout.pads))
        times = rng.choice([0.5, 2.0])
        on_it = layout.pad_of == pad
        seen = [
            np.where(on_it, np.minimum(times * frames, layout.full_scale), frames) for frames in log
        ]
        change = pad_change(seen, reference, layout, cells)
        told += change is not None and change.pad == pad
        wrong += change is not None and change.pad != pad
        blamed += len(bench.fitted.diagnose(seen).fault_set)
    yield Count("a replaced pad: told", told, bench.count)
    yield Count("  another pad told", wrong, bench.count, higher=False)
    yield Count("  healthy cells blamed in a log", blamed, bench.count, higher=False)
    yield Count("healthy: a replaced pad told in a log", healthy, bench.count, higher=False)


def summaries(recordings: Sequence[np.ndarray]) -> np.ndarray:
    """Return mean and maximum of each cell in each recording, ``[n, 2 D]``."""
    return np.array(
        [np.concatenate([frames.mean(axis=0), frames.max(axis=0)]) for frames in recordings]
    )


def specimen(bench: Bench) -> Iterator[Count]:
    """A pad, or in every other draw all pads, have other gains, offsets and noise for each cell:
    recalibrated."""
    layout = bench.layout
    fitted = bench.fitted
    draws = max(2, bench.count // 15)
    frames = [np.asarray(f, dtype=np.float64) for f in bench.recordings.frames]
    labels = bench.recordings.labels
    reference = [frames[i] for i in bench.reference]
    full = layout.full_scale
    pad_of = layout.pad_of
    trees = ExtraTreesClassifier(300, random_state=0).fit(
        summaries(reference), labels[bench.reference]
    )
    told = 0
    blamed = Counter()
    right = Counter()
    of = 0
    for draw in range(draws):
        rng = np.random.default_rng(1000 * bench.repeat + draw)
        on = pad_of == rng.integers(layout.pads) if draw % 2 == 0 else np.full(layout.n_cells, True)
        gain = np.where(on, np.exp(rng.uniform(-np.log(2), np.log(2), layout.n_cells)), 1.0)
        offset = np.where(on, np.abs(rng.normal(0, 0.02 * full, layout.n_cells)), 0.0)
        noise = [0.002 * full * on * rng.standard_normal(f.shape) for f in frames]
        seen = [np.clip(gain * f + offset + n, 0, full) for f, n in zip(frames, noise, strict=True)]
        order = rng.permutation(bench.rest)
        new = order[:SPECIMEN]
        test = order[SPECIMEN:]
        faulty = np.zeros(layout.n_cells, bool)
        under = fitted.diagnose([seen[i] for i in new]).statically_loaded.mask
        assert fitted.reference_ is not None
        found = find_recalibration(
            [seen[i] for i in new], reference, fitted.reference_, layout, faulty, under
        )
        told += found is not None and set(found.pads) == set(pad_of[on].tolist())
        given = {"earlier": frames, "new": seen, "recalibrated": seen}
        if found is not None:
            given["recalibrated"] = [found.undo(f, full) for f in seen]
        of += len(test)
        for name, readings in given.items():
            predicted = trees.predict(summaries([readings[i] for i in test]))
            right[name] += int((predicted == labels[test]).sum())
            blamed[name] += len(fitted.diagnose([readings[i] for i in test[:6]]).fault_set)
    yield Count("another specimen of a pad: told", told, draws)
    for name in right:
        yield Count(f"  accuracy, {name}", right[name], of)
        yield Count(f"  healthy cells blamed in a log, {name}", blamed[name], draws, higher=False)


def neighbours(layout: SensorLayout, cell: int) -> list[int]:
    """Return the present cells around a cell, diagonal ones included."""
    pad, row, col = layout.position(cell)
    near = layout.present[pad, max(0, row - 1) : row + 2, max(0, col - 1) : col + 2]
    rows, cols = np.nonzero(near)
    around = [
        layout.cell(pad, max(0, row - 1) + int(r), max(0, col - 1) + int(c))
        for r, c in zip(rows, cols, strict=True)
    ]
    return [other for other in around if other != cell]


def object_of(bench: Bench, log_seed: int, rng: np.random.Generator) -> np.ndarray:
    """Return the loads ``[D]`` of an object that lies still: cut out of a recording, a bump, or a
    strap, in turn."""
    least = VISIBLE * bench.layout.full_scale
    layout = bench.layout
    top = max(float(np.max(bench.recordings.frames[i])) for i in bench.rest)
    while True:
        load = np.zeros(layout.n_cells)
        if log_seed % 3 == 0:
            frames = np.asarray(bench.recordings.frames[rng.choice(bench.rest)], dtype=np.float64)
            contact = frames[frames.sum(axis=1).argmax()] - frames.min(axis=0)
            loaded = np.flatnonzero((contact > least) & layout.present.ravel())
            if not len(loaded):
                continue
            patch = [int(rng.choice(loaded))]
            size = int(rng.integers(3, 13))
            for cell in patch:  # grows while it is walked through
                more = [
                    c
                    for c in rng.permutation(neighbours(layout, cell)).tolist()
                    if c in loaded and c not in patch
                ]
                patch += more[: size - len(patch)]
            load[patch] = contact[patch]
        else:
            pad, row, col = layout.position(int(rng.choice(np.flatnonzero(layout.present))))
            r, c = np.mgrid[: layout.rows, : layout.cols]
            if log_seed % 3 == 1:
                distance = np.hypot(
                    r - row - rng.uniform(-0.5, 0.5), c - col - rng.uniform(-0.5, 0.5)
                )
                shape = rng.uniform(0.2, 0.8) * np.exp(
                    -0.5 * (distance / rng.uniform(0.7, 1.5)) ** 2
                )
            else:
                angle = rng.uniform(0, np.pi)
                across = (r - row) * np.sin(angle) + (c - col) * np.cos(angle)
                along = (c - col) * np.sin(angle) - (r - row) * np.cos(angle)
                uneven = 1 + 0.3 * np.sin(along / 2 + rng.uniform(0, 6))
                shape = rng.uniform(0.15, 0.5) * uneven * np.exp(-0.5 * (across / 0.6) ** 2)
            load = np.zeros(layout.shape)
            load[pad] = top * shape
            load = np.where(load.ravel() > least, load.ravel(), 0.0) * layout.present.ravel()
        if np.count_nonzero(load) >= 3:
            return load


def static(bench: Bench) -> Iterator[Count]:
    """An object lies still while the contacts of a log go on: constant, within a converter count,
    or with noise."""
    layout = bench.layout
    blamed = 0
    told = 0
    asked = 0
    invented = 0
    tally = Tally()
    for seed, log, rng in bench.logs(UNDER):
        load = object_of(bench, seed, rng)
        length = sum(map(len, log))
        onset = int(length * rng.choice([0.0, rng.uniform(0.2, 0.6)]))
        noise = layout.full_scale * rng.choice([0.0, 1 / 4095, 0.003])
        whole = np.concatenate(log)
        held = load + noise * rng.standard_normal(whole.shape).round(1) * (load > 0)
        laid = np.where(
            (np.arange(length) >= onset)[:, None],
            np.clip(whole + held, 0, layout.full_scale),
            whole,
        )
        diagnosis = bench.fitted.diagnose(parted(laid, log))
        blamed += len(diagnosis.fault_set)
        lie = {cell for still in diagnosis.static_loads for cell in still.cells}
        under = set(np.flatnonzero(load).tolist())
        asked = asked + 1
        told = told + bool(lie & under)
        invented += sum(not under & set(still.cells) for still in diagnosis.static_loads)
        faults = [
            fault
            for fault in draw_faults(layout, 0.08, STUCK_KINDS, rng)
            if under.isdisjoint(fault.cells)
        ]
        seen = list(broken(parted(laid, log), faults, layout, 0.0, 0.0, seed))
        tally.add(parted(laid, log), seen, faults, bench.fitted.diagnose(seen), 0)
    yield Count("an object lies still: healthy cells blamed in a log", blamed, asked, higher=False)
    yield Count("  told", told, asked)
    yield Count("  told where nothing lies", invented, asked, higher=False)
    yield from tally.counts("an object lies still, 8 % dead")


def transport(bench: Bench) -> Iterator[Count]:
    layout = bench.layout
    told = 0
    blamed = 0
    for seed, log, rng in bench.logs():
        seen = {
            "lost": [lose_frames(frames, 0.2, seed=1000 * seed + i) for i, frames in enumerate(log)]
        }
        lost = sum(int(np.isnan(frames).all(axis=1).sum()) for frames in seen["lost"])
        whole = np.concatenate(log)
        loaded = (whole > VISIBLE * layout.full_scale).sum(axis=1)
        at = int(rng.choice(np.flatnonzero(loaded >= np.quantile(loaded, 0.75))))
        assert bench.fitted.reference_ is not None
        again = bench.fitted.reference_.patience + REPEATED
        seen["frozen"] = [
            np.insert(whole, at, np.repeat(whole[at : at + 1], again, axis=0), axis=0)
        ]
        for name, frames in seen.items():
            diagnosis = bench.fitted.diagnose(frames)
            of_it = [fault for fault in diagnosis.transport if fault.kind == name]
            told += len(of_it) == len(diagnosis.transport) == 1 and (
                name == "frozen" or of_it[0].frames == lost
            )
            blamed += len(diagnosis.fault_set)
    yield Count("lost frames, frozen stream: reported", told, 2 * bench.count)
    yield Count("  cells blamed in a log", blamed, 2 * bench.count, higher=False)


MONITORED = 3  # times the rate at which frames come to a monitor


def matrix_product() -> float:
    """Return how many ms this machine needs for the product of two 500 x 500 matrices of float32:
    its speed today."""
    a = np.random.default_rng(0).random((500, 500), dtype=np.float32)
    seconds = []
    for _ in range(30):
        began = time.perf_counter()
        a @ a
        seconds.append(time.perf_counter() - began)
    return 1000 * float(np.median(seconds))


def long_log(frames: Sequence[np.ndarray], length: int) -> np.ndarray:
    whole = np.concatenate([np.asarray(f, dtype=np.float64) for f in frames])
    return np.tile(whole, (-(-length // len(whole)), 1))[:length]


def speed(bench: Bench) -> Iterator[Count]:
    """Times are given in matrix products (see :func:`matrix_product`), measured in turn with the
    work."""
    began = time.perf_counter()
    fitted = SelfDiagnosis(bench.layout).fit([bench.recordings.frames[i] for i in bench.reference])
    yield Count(
        "fit", 1000 * (time.perf_counter() - began), matrix_product(), "products", higher=False
    )
    log = long_log(
        [bench.recordings.frames[i] for i in bench.rest],
        20_000 if bench.layout.n_cells < 500 else 4_000,
    )
    ratios = []
    for _ in range(5):
        began = time.perf_counter()
        fitted.diagnose(log)
        ratios.append(1000 * (time.perf_counter() - began) / matrix_product())
    size = log.size / bench.layout.n_cells * bench.layout.present.sum() / 1e6
    yield Count(
        "batch, a million cell-frames", float(np.median(ratios)), size, "products", higher=False
    )
    runs = np.empty((3, min(len(log), 1500)))
    for run in runs:  # what a frame takes each time is the code, what it takes once is the machine
        monitor = Monitor(fitted)
        starts = time.perf_counter()
        for i, frame in enumerate(log[: runs.shape[1]]):
            due = starts + i / (MONITORED * bench.layout.rate)
            time.sleep(max(0.0, due - time.perf_counter()))
            began = time.perf_counter()
            monitor.update(frame)
            run[i] = 1000 * (time.perf_counter() - began)
    ms = runs[:, 200:].min(axis=0)
    product = matrix_product()
    for name, value in (
        ("mean", ms.mean()),
        ("slowest in 100", np.quantile(ms, 0.99)),
        ("slowest", ms.max()),
    ):
        yield Count(f"Monitor.update, {name}", float(value), product, "products", higher=False)


ROWS: dict[str, Callable[[Bench], Iterator[Count]]] = {
    row.__name__: row
    for row in (
        cells,
        onset,
        dither,
        missing,
        many,
        cold,
        own_reference,
        reference_faults,
        lines,
        cut,
        address,
        healthy,
        holds,
        untouched,
        kind,
        calibration,
        changing,
        gain,
        moving,
        proven,
        failing,
        crossing,
        worn,
        rewired,
        groups,
        replaced,
        specimen,
        static,
        transport,
        speed,
    )
}
