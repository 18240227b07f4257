"""How well faults are found, on simulated grasps or your own: python examples/diagnosis_figures.py [RECORDINGS [LOGS]]

Prints, row by row, what was wanted of the diagnosis, what was measured, and on how many logs. Half of the recordings
teach what healthy looks like (``--split`` deals the halves anew); each log is six recordings of the other half, with
faults from ``inject``. ``--only NAME ...`` picks rows. Without RECORDINGS a few logs of simulated grasps must do, and
the slow rows are left out.

A faulty cell is testable if what it hides differs from what it reads by over 5 % of full scale in at least 10 frames of
the log. "A frame that can be observed" is one in which it differs by that much.

The method was developed on split 0 of the real hand (SCHUNK SDH-2, 856 grasps): what that split gives is no
independent proof. Other splits share its recordings in other halves; only another array is new data. What its constants
are worth: ``diagnosis_constants.py``.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np
from statsmodels.stats.proportion import proportion_confint

from adaptfault.grasps import simulate
from adaptfault.recordings import Recordings, load
from diagnostics import Diagnosis, Fault, FaultKind, Line, Monitor, SelfDiagnosis, SensorLayout, Verdict, inject
from diagnostics.injection import line_fault, lose_frames

Log = list[np.ndarray]
STILL_KINDS = ("open", "short", "stuck")
SHOWN, ENOUGH = 0.05, 10  # of full scale; frames
HELD, WINDOW = 300, 50  # frames of a static hold; of a window in which a cell can raise a false alarm
REPEATED = 100  # frames of a frozen stream, beyond the longest repetition that is still taken for idleness
MOVING = (FaultKind.INTERMITTENT, FaultKind.NOISY, FaultKind.DRIFT)
GAINS, FADED = (0.2, 0.35, 0.5), 0.1  # times the load; what is left at the end
MANY, SOME = 30, 8  # recordings that tell a gain; in so many of them the cell is loaded


def draw_faults(layout: SensorLayout, share: float, kinds: tuple[str, ...], rng: np.random.Generator) -> list[Fault]:
    present = np.flatnonzero(layout.present)
    cells = rng.choice(present, round(share * len(present)), replace=False)
    return [
        Fault(kind, (int(cell),), value=rng.uniform(0.1, 0.9) * layout.full_scale if kind == "stuck" else None)
        for cell, kind in zip(cells, rng.choice([FaultKind(k) for k in kinds], len(cells)), strict=True)
    ]


def broken(log: list[np.ndarray], faults: list[Fault], layout: SensorLayout, onset: float, dither: float, seed: int):
    """Yield the recordings of a log that breaks when a share ``onset`` of its frames is over."""
    start = round(onset * sum(map(len, log)))
    for i, frames in enumerate(log):
        here = [Fault(f.kind, f.cells, line=f.line, value=f.value, onset=max(0, start)) for f in faults]
        yield inject(frames, here, layout, seed=1000 * seed + i, dither=dither)
        start -= len(frames)


def logs(
    recordings: Recordings, which: np.ndarray, count: int
) -> Iterator[tuple[list[np.ndarray], np.random.Generator]]:
    for seed in range(count):
        rng = np.random.default_rng(seed)
        yield [recordings.frames[i] for i in rng.choice(which, min(6, len(which)), replace=False)], rng


def differs(a: np.ndarray, b: np.ndarray, layout: SensorLayout) -> np.ndarray:
    return np.abs(a - b) > SHOWN * layout.full_scale


def parted(whole: np.ndarray, log: Log) -> Log:
    """Return frames ``[T, D]`` of all of a log as its recordings."""
    return np.split(whole, np.cumsum([len(frames) for frames in log])[:-1])


def kind_of_cells(faults: Sequence[Fault]) -> dict[int, FaultKind]:
    return {cell: fault.kind for fault in faults for cell in fault.cells}


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    case: str
    wanted: str
    measured: str
    logs: int
    met: bool | None = None  # None: nothing was asked, or the logs cannot tell


@dataclass
class Tally:
    """What was found of dead cells in some logs."""

    true: int = 0
    false: int = 0
    testable: int = 0
    hit: int = 0
    right_kind: int = 0
    late: list[int] = field(default_factory=list)  # frames that could be observed between true and reported onset
    probability: list[np.ndarray] = field(default_factory=list)
    dead: list[np.ndarray] = field(default_factory=list)

    @property
    def precision(self) -> float:
        """NaN if nothing was called dead."""
        return self.true / (self.true + self.false) if self.true + self.false else float("nan")

    @property
    def recall(self) -> float:
        """Share of the testable dead cells that were found."""
        return self.hit / self.testable if self.testable else float("nan")

    def add(self, log: Log, seen: Log, faults: Sequence[Fault], diagnosis: Diagnosis, start: int) -> None:
        """Count one log: what it was, what came of it, and what was said of it; ``start``: when the faults began."""
        layout, found = diagnosis.layout, diagnosis.fault_set
        before, after = np.concatenate(log), np.concatenate(seen)
        can = set(np.flatnonzero(differs(before, after, layout).sum(axis=0) >= ENOUGH).tolist())
        kinds = kind_of_cells(faults)
        told = {cell: fault for fault in diagnosis.faults for cell in fault.cells}
        self.true, self.false = self.true + len(found & kinds.keys()), self.false + len(found - kinds.keys())
        self.testable, self.hit = self.testable + len(can), self.hit + len(found & can)
        self.right_kind += sum(kinds.get(cell) == fault.kind for cell, fault in told.items())
        for cell in found & can:
            between = slice(*sorted((start, told[cell].onset or 0)))
            # What it reads while dead is the last frame of the log: the fault lasts.
            self.late.append(int(differs(before[between, cell], after[-1, cell], layout).sum()))
        present = layout.present.ravel()
        self.probability.append(diagnosis.probability[present])
        self.dead.append(np.isin(np.flatnonzero(present), list(kinds)))


@dataclass
class Bench:
    """Recordings, dealt into two halves, and the diagnosis that learned from one of them."""

    recordings: Recordings
    split: int
    count: int

    def __post_init__(self) -> None:
        self.layout = self.recordings.layout
        order = np.random.default_rng(self.split).permutation(len(self.recordings))
        self.reference, self.rest = order[: len(order) // 2], order[len(order) // 2 :]
        self.case = cache(self._case)

    @cached_property
    def fitted(self) -> SelfDiagnosis:
        """The diagnosis under test."""
        began = time.perf_counter()
        fitted = self.learned()
        print(f"fitted on {len(self.reference)} recordings in {time.perf_counter() - began:.1f} s", flush=True)
        return fitted

    def learned(self) -> SelfDiagnosis:
        """Return what a diagnosis learns from the reference."""
        return SelfDiagnosis(self.layout).fit([self.recordings.frames[i] for i in self.reference])

    def logs(self) -> Iterator[tuple[int, Log, np.random.Generator]]:
        """Yield seed, log and a generator for its faults."""
        for seed, (log, rng) in enumerate(logs(self.recordings, self.rest, self.count)):
            yield seed, [np.asarray(frames, dtype=np.float64) for frames in log], rng

    def _case(self, share: float, onset: float = 0.0, kinds: tuple[str, ...] = STILL_KINDS, dither: float = 0.0):
        return dead_cells(self, self.fitted, share, onset, kinds, dither)


def dead_cells(
    bench: Bench,
    fitted: SelfDiagnosis,
    share: float,
    onset: float = 0.0,
    kinds: tuple[str, ...] = STILL_KINDS,
    dither: float = 0.0,
) -> Tally:
    tally = Tally()
    for seed, log, rng in bench.logs():
        faults = draw_faults(bench.layout, share, kinds, rng)
        seen = list(broken(log, faults, bench.layout, onset, dither, seed))
        start = round(onset * sum(map(len, log)))
        tally.add(log, seen, faults, fitted.diagnose(seen), start)
    return tally


def percent(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "no case"


def precision_and_recall(case: str, tally: Tally, precision: float, recall: float, count: int) -> Row:
    measured = f"precision {tally.precision:.4f} ({tally.false} false of {tally.true + tally.false})"
    measured += f", recall {tally.recall:.4f} ({tally.testable - tally.hit} of {tally.testable} missed)"
    met = tally.precision >= precision and tally.recall >= recall
    return Row(case, f"precision >= {precision}, recall >= {recall}", measured, count, met)


def cells(bench: Bench) -> Iterator[Row]:
    yield precision_and_recall("16 % of the cells dead", bench.case(0.16), 0.995, 0.98, bench.count)


def onset(bench: Bench) -> Iterator[Row]:
    tally = bench.case(0.16, onset=0.6)
    yield precision_and_recall("the same, from 60 % of the log on", tally, 0.99, 0.96, bench.count)
    late = np.array(tally.late or [np.nan])
    measured = f"median {np.median(late):.0f}, 90th percentile {np.quantile(late, 0.9):.0f} ({len(tally.late)} cells)"
    yield Row("  its onset, frames off", "median <= 5", measured, bench.count, bool(np.median(late) <= 5))


def dither(bench: Bench) -> Iterator[Row]:
    tally = bench.case(0.16, kinds=("stuck",), dither=0.004)
    yield precision_and_recall("mid-range, dither +-0.4 %", tally, 0.99, 0.98, bench.count)


def many(bench: Bench) -> Iterator[Row]:
    yield precision_and_recall("40 % dead", bench.case(0.4), 0.99, 0.96, bench.count)
    for share in (0.6, 0.8, 1.0):
        try:
            tally = bench.case(share)
        except Exception as error:  # what is asked is that there is none
            yield Row(f"{100 * share:.0f} % dead", "no crash", f"{type(error).__name__}: {error}", bench.count, False)
            continue
        measured = f"none; precision {tally.precision:.4f}, recall {tally.recall:.4f}"
        yield Row(f"{100 * share:.0f} % dead", "no crash", measured, bench.count, True)


def wires(layout: SensorLayout) -> list[Line]:
    return [line for line in layout.lines if line.kind in ("row", "column")]


def lines(bench: Bench) -> Iterator[Row]:
    layout, exact, shares, extra = bench.layout, [], [], Counter()
    for seed, log, rng in bench.logs():
        choice = wires(layout)
        while True:
            a, b = (choice[i] for i in rng.choice(len(choice), 2, replace=False))
            if a.pad != b.pad or a.kind == b.kind:  # they do not cross
                break
        kinds = rng.choice([FaultKind.OPEN, FaultKind.SHORT], 2)
        on_lines = [line_fault(layout, line, FaultKind(kind)) for line, kind in zip((a, b), kinds, strict=True)]
        behind = {cell for fault in on_lines for cell in fault.cells}
        single = [fault for fault in draw_faults(layout, 0.04, STILL_KINDS, rng) if behind.isdisjoint(fault.cells)]
        seen = list(broken(log, on_lines + single, layout, 0.0, 0.0, seed))
        testable = differs(np.concatenate(log), np.concatenate(seen), layout).sum(axis=0) >= ENOUGH
        found = {(f.line, f.kind) for f in bench.fitted.diagnose(seen).faults if f.line is not None}
        true = {(fault.line, fault.kind) for fault in on_lines}
        exact.append(found == true)
        extra["invented"] += len(found - true)
        extra["missed"] += len(true - found)
        shares.append(all(testable[list(f.cells)].sum() >= 3 for f in on_lines if f.kind is FaultKind.OPEN))
    right, could = np.array(exact), np.array(shares)
    wanted, detail = "exact wires in >= 97 % of the logs", f"{extra['missed']} missed and {extra['invented']} invented"
    measured = percent(right[could].sum(), could.sum())
    case = "2 lines cut or shorted + 4 % of the cells"
    met = bool(right[could].mean() >= 0.97) if could.any() else None
    measured += " of the logs in which each cut line has >= 3 testable cells"
    yield Row(case, wanted, measured, int(could.sum()), met)
    yield Row("  the same, over all logs", "-", f"{percent(right.sum(), len(right))}; {detail}", len(right))


def cut(bench: Bench) -> Iterator[Row]:
    layout, exact, named, asked = bench.layout, 0, 0, 0
    for seed, log, rng in bench.logs():
        touched = differs(np.concatenate(log), np.zeros(layout.n_cells), layout).sum(axis=0) >= ENOUGH
        choice = []
        for line in wires(layout):
            across = 2 if line.kind == "row" else 1
            on_line = layout.cells_on(line)
            place = [layout.position(cell)[across] for cell in on_line.tolist()]
            for i in range(1, len(on_line)):
                # Both cells beside the break were touched, and another one behind it.
                if touched[on_line[[i - 1, i]]].all():
                    if touched[on_line[i:]].sum() >= 2:
                        choice.append((line, place[i], "first"))
                    if touched[on_line[:i]].sum() >= 2:
                        choice.append((line, place[i - 1] + 1, "last"))
        if not choice:
            continue
        line, at, end = choice[rng.integers(len(choice))]
        fault = line_fault(layout, line, FaultKind.OPEN, break_at=at, driven_from=end)
        found = bench.fitted.diagnose(list(broken(log, [fault], layout, 0.0, 0.0, seed))).faults
        on_it = [f for f in found if f.line == line]
        asked, named = asked + 1, named + bool(on_it)
        exact += any(f.cells == fault.cells for f in on_it)
    measured = f"{percent(exact, asked)} ({asked - exact} wrong); line named in {percent(named, asked)}"
    case = "a cut inside a line, both sides tested"
    yield Row(case, "break exact in >= 90 %", measured, asked, exact >= 0.9 * asked if asked else None)


def address(bench: Bench) -> Iterator[Row]:
    layout, asked, named, right, blamed = bench.layout, 0, 0, 0, 0
    choice = [line for line in layout.lines if line.kind in ("row_address", "column_address")]
    for seed, log, rng in bench.logs():
        line, level = choice[rng.integers(len(choice))], int(rng.integers(2))
        fault = line_fault(layout, line, FaultKind.ALIAS, value=level)
        seen = list(broken(log, [fault], layout, 0.0, 0.0, seed))
        if differs(np.concatenate(log), np.concatenate(seen), layout).any(axis=1).sum() < ENOUGH:
            continue
        diagnosis = bench.fitted.diagnose(seen)
        on_it = [f for f in diagnosis.faults if f.kind is FaultKind.ALIAS and f.line == line]
        asked, named = asked + 1, named + bool(on_it)
        right += any(f.value == level for f in on_it)
        blamed += len(diagnosis.fault_set - set(fault.cells))
    measured = f"bit {percent(named, asked)}, bit and level {percent(right, asked)}; {blamed} other cells blamed"
    case = f"address bit stuck, seen in >= {ENOUGH} frames"
    yield Row(case, "bit and the row it copies in >= 95 %", measured, asked, right >= 0.95 * asked if asked else None)


def held(log: Log, layout: SensorLayout, rng: np.random.Generator) -> Log:
    """Return a log in which the last frame of each recording is held, the loaded cells within +-1 converter count."""
    count, seen = layout.full_scale / 4095, []
    for frames in log:
        jitter = count * rng.integers(-1, 2, (HELD, layout.n_cells)) * (frames[-1] > count)
        seen.append(np.concatenate([frames, np.clip(frames[-1] + jitter, 0.0, layout.full_scale)]))
    return seen


def windows_of(log: Log, layout: SensorLayout) -> int:
    """Return in how many windows a cell could raise a false alarm."""
    return round(layout.present.sum() * sum(map(len, log)) / WINDOW)


def healthy(bench: Bench) -> Iterator[Row]:
    layout, total_false, total_windows = bench.layout, 0, 0
    results = []
    for case in ("healthy logs", "logs with static holds"):
        false = windows = 0
        for _, log, rng in bench.logs():
            seen = log if case == "healthy logs" else held(log, layout, rng)
            false += len(bench.fitted.diagnose(seen).fault_set)
            windows += windows_of(seen, layout)
        results.append((f"  {case}", false, windows, bench.count))
        total_false, total_windows = total_false + false, total_windows + windows
    results.insert(0, ("healthy, static holds included", total_false, total_windows, 2 * bench.count))
    for case, false, windows, count in results:
        # One-sided, so that 95 % of such bounds hold.
        bound = proportion_confint(false, windows, alpha=0.1, method="beta")[1]
        rate = 1e6 * false / windows
        measured = f"{rate:.1f} ({false} in {windows} windows), 95 % bound {1e6 * bound:.1f}"
        if case.startswith(" "):
            yield Row(case, "-", measured, count)
        else:  # few windows prove nothing, either way
            met = None if rate <= 10 < 1e6 * bound else rate <= 10
            measured += ": too few windows to prove it" if met is None else ""
            yield Row(case, "<= 10 false alarms a million windows", measured, count, met)


def untouched(bench: Bench) -> Iterator[Row]:
    asked = faulty = alive = 0
    for _, log, _ in bench.logs():
        never = (np.ptp(np.concatenate(log), axis=0) == 0) & bench.layout.present.ravel()
        verdicts = bench.fitted.diagnose(log).verdicts[never]
        asked += int(never.sum())
        faulty, alive = faulty + int((verdicts == Verdict.FAULTY).sum()), alive + int((verdicts == Verdict.ALIVE).sum())
    measured = f"{faulty} FAULTY and {alive} ALIVE of {asked}"
    yield Row("cells never touched, healthy logs", "none FAULTY, none ALIVE", measured, bench.count, not faulty + alive)


def kind(bench: Bench) -> Iterator[Row]:
    tallies = [bench.case(0.16), bench.case(0.16, onset=0.6), bench.case(0.4)]
    tallies.append(bench.case(0.16, kinds=("stuck",), dither=0.004))
    true, right = sum(t.true for t in tallies), sum(t.right_kind for t in tallies)
    measured = f"{percent(right, true)} ({true - right} wrong of {true})"
    yield Row("kind of fault, the cases above", ">= 99 %", measured, 4 * bench.count, right >= 0.99 * true)


def calibration(bench: Bench) -> Iterator[Row]:
    tallies = [bench.case(0.16), bench.case(0.16, onset=0.6), bench.case(0.4)]
    p, y = (np.concatenate([x for t in tallies for x in getattr(t, name)]) for name in ("probability", "dead"))
    where = np.minimum((10 * p).astype(int), 9)
    error = sum(abs(p[where == b].sum() - y[where == b].sum()) for b in range(10)) / len(p)
    measured = f"{error:.4f} ({len(p)} cells, 10 bins)"
    yield Row("P(fault), 16 %, onset and 40 %", "calibration error <= 0.02", measured, 3 * bench.count, error <= 0.02)


def moving(bench: Bench) -> Iterator[Row]:
    layout, drawn, found, right, false = bench.layout, Counter(), Counter(), Counter(), 0
    for seed, log, rng in bench.logs():
        whole = np.concatenate(log)
        loaded = np.flatnonzero((whole > SHOWN * layout.full_scale).sum(axis=0) > 40)
        cells = rng.permutation(loaded)[: 3 * len(MOVING)].tolist()
        faults = [Fault(MOVING[i % len(MOVING)], (cell,)) for i, cell in enumerate(cells)]
        # In one piece: a drift goes on from recording to recording.
        seen = inject(whole, faults, layout, seed=seed)
        diagnosis = bench.fitted.diagnose(parted(seen, log))
        told = kind_of_cells(diagnosis.faults)
        for fault in faults:
            drawn[fault.kind] += 1
            found[fault.kind] += fault.cells[0] in told
            right[fault.kind] += told.get(fault.cells[0]) is fault.kind
        false += len(diagnosis.fault_set - set(cells))
    for k in MOVING:
        measured = f"found {percent(found[k], drawn[k])} of {drawn[k]}, kind right in {percent(right[k], found[k])}"
        yield Row(f"{k}, loaded in > 40 frames", "-", measured, bench.count)
    yield Row("  other cells of these logs", "-", f"{false} false", bench.count)


def gain(bench: Bench) -> Iterator[Row]:
    """One touch says little of a gain: these logs are longer."""
    layout, rest, drawn, named, false = bench.layout, bench.rest, Counter(), Counter(), 0
    for seed in range(bench.count):
        rng = np.random.default_rng(seed)
        log = [bench.recordings.frames[i] for i in rng.choice(rest, min(MANY, len(rest)), replace=False)]
        whole = np.concatenate(log).astype(np.float64)
        loaded = sum((frames > SHOWN * layout.full_scale).any(axis=0).astype(int) for frames in log)
        cells = rng.permutation(np.flatnonzero(loaded >= SOME)).tolist()
        lasts = len(whole) / layout.rate  # seconds
        fading = [Fault(FaultKind.DRIFT, (cell,), value=0.0) for cell in cells[:1]]
        seen = inject(whole, fading, layout, gain=(FADED - 1) / lasts)
        cases = dict(zip(cells, (f"gain fades to {FADED}", *(f"gain {g}" for g in GAINS)), strict=False))
        for cell, times in zip(cells[1:], GAINS, strict=False):
            seen[:, cell] *= times
        diagnosis = bench.fitted.diagnose(parted(seen, log))
        told = kind_of_cells(diagnosis.faults)
        for cell, case in cases.items():
            drawn[case] += 1
            named[case] += told.get(cell) is FaultKind.DRIFT
        false += len(diagnosis.fault_set - set(cases))
    for case in sorted(drawn):
        measured = f"found and named {percent(named[case], drawn[case])} of {drawn[case]}"
        yield Row(f"{case}, in {SOME} of {MANY} recordings", "-", measured, bench.count)
    yield Row("  other cells of these logs", "-", f"{false} false", bench.count)


def transport(bench: Bench) -> Iterator[Row]:
    layout, told, blamed = bench.layout, Counter(), Counter()
    for seed, log, rng in bench.logs():
        seen = {"lost": [lose_frames(frames, 0.2, seed=1000 * seed + i) for i, frames in enumerate(log)]}
        lost = sum(int(np.isnan(frames).all(axis=1).sum()) for frames in seen["lost"])
        whole = np.concatenate(log)
        loaded = (whole > SHOWN * layout.full_scale).sum(axis=1)
        at = int(rng.choice(np.flatnonzero(loaded >= np.quantile(loaded, 0.75))))
        again = bench.fitted.memory().reference.patience + REPEATED
        seen["frozen"] = [np.insert(whole, at, np.repeat(whole[at : at + 1], again, axis=0), axis=0)]
        for name, frames in seen.items():
            diagnosis = bench.fitted.diagnose(frames)
            of_it = [fault for fault in diagnosis.transport if fault.kind == name]
            told[name] += len(of_it) == len(diagnosis.transport) == 1 and (name == "frozen" or of_it[0].frames == lost)
            blamed[name] += len(diagnosis.fault_set)
    for name, case in (("lost", "20 % of the frames lost"), ("frozen", "stream frozen under load")):
        measured = f"reported in {percent(told[name], bench.count)}, {blamed[name]} cells blamed"
        yield Row(
            case, "reported, no cell blamed", measured, bench.count, told[name] == bench.count and not blamed[name]
        )


def matrix_product() -> float:
    """Return how many ms this machine needs for the product of two 500 x 500 matrices of float32: its speed today."""
    a, seconds = np.random.default_rng(0).random((500, 500), dtype=np.float32), []
    for _ in range(30):
        began = time.perf_counter()
        a @ a
        seconds.append(time.perf_counter() - began)
    return 1000 * float(np.median(seconds))


def long_log(frames: Sequence[np.ndarray], length: int) -> np.ndarray:
    whole = np.concatenate([np.asarray(f, dtype=np.float64) for f in frames])
    return np.tile(whole, (-(-length // len(whole)), 1))[:length]


def batch_speed(fitted: SelfDiagnosis, log: np.ndarray, wanted: float | None) -> Row:
    seconds = []
    for _ in range(10):
        began = time.perf_counter()
        fitted.diagnose(log)
        seconds.append(time.perf_counter() - began)
    cells = int(fitted.layout.present.sum())
    speed, usual = (len(log) * cells / taken / 1e6 for taken in (min(seconds), float(np.median(seconds))))
    measured = f"{speed:.2f} million cell-frames/s, at the median {usual:.2f} ({len(log)} frames, 10 times)"
    measured += f"; a million takes {1000 / usual / matrix_product():.0f} matrix products"
    asked = f">= {wanted:g} million cell-frames/s" if wanted else "-"
    return Row(f"batch, {cells} cells", asked, measured, 1, speed >= wanted if wanted else None)


def monitor_speed(fitted: SelfDiagnosis, log: np.ndarray, asked: bool) -> Row:
    """The log goes by three times: what a frame takes each time is the code, what it takes once is the machine."""
    milliseconds = np.empty((3, len(log)))
    for run in milliseconds:
        monitor = Monitor(fitted)
        for i, frame in enumerate(log):
            began = time.perf_counter()
            monitor.update(frame)
            run[i] = 1000 * (time.perf_counter() - began)
    runs = milliseconds[:, 200:]
    ms, once = runs.min(axis=0), runs.max()
    product, (median, rare, most) = matrix_product(), (np.median(ms), np.quantile(ms, 0.99), ms.max())
    measured = f"median {median:.3f} ms, 99 % {rare:.2f} ms, slowest {most:.2f} ms ({len(ms)} frames, the least of"
    measured += f" three runs; {once:.1f} ms once); in matrix products ({product:.2f} ms) {median / product:.2f},"
    measured += f" {rare / product:.1f}, {most / product:.1f}"
    wanted, met = ("median <= 0.2 ms, max <= 5 ms", bool(median <= 0.2 and most <= 5)) if asked else ("-", None)
    return Row(f"monitor, {fitted.layout.present.sum()} cells", wanted, measured, 1, met)


def speed(bench: Bench) -> Iterator[Row]:
    """The arrays of 220 and 2048 cells learn from nine simulated grasps: how fast it is does not depend on them."""
    log = long_log([bench.recordings.frames[i] for i in bench.rest], 20_000)
    yield batch_speed(bench.fitted, log, None)
    yield monitor_speed(bench.fitted, log[:4000], False)
    for layout, length, wanted in ((SensorLayout.paper(), 20_000, 5.0), (SensorLayout(1, 64, 32), 2_000, 1.0)):
        grasps = simulate(3, layout, n_frames=60, seed=3, classes=("normal", "void", "harder")).frames
        fitted = SelfDiagnosis(layout).fit(grasps)
        log = long_log(simulate(5, layout, n_frames=60, seed=4).frames, length)
        yield batch_speed(fitted, log, wanted)
        yield monitor_speed(fitted, log[:4000], layout.n_cells == 220)


ROWS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    row.__name__: row
    for row in (
        cells,
        onset,
        dither,
        many,
        lines,
        cut,
        address,
        healthy,
        untouched,
        kind,
        calibration,
        moving,
        gain,
        transport,
        speed,
    )
}
SLOW = {"speed": "it fits arrays of 220 and 2048 cells"}


def show(row: Row) -> None:
    met = {None: "", True: "met", False: "MISSED"}[row.met]
    print(f"{met:7s}{row.case:45s}{row.wanted:41s}{row.logs:5d} logs  {row.measured}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="How well faults are found: what was wanted, and what was measured")
    parser.add_argument("recordings", nargs="?", help="fault-free recordings; without: simulated grasps")
    parser.add_argument("logs", nargs="?", type=int, help="logs a row (default 20; 4 of simulated grasps)")
    parser.add_argument("--split", type=int, default=0, help="seed of the halves (default 0)")
    parser.add_argument("--only", nargs="+", choices=ROWS, metavar="NAME", help=f"rows: {', '.join(ROWS)}")
    options = parser.parse_args()
    recordings = load(options.recordings).recordings if options.recordings else small()
    bench = Bench(recordings, options.split, options.logs or (20 if options.recordings else 4))
    print(f"{len(recordings)} recordings of {recordings.layout}, split {options.split}; {bench.count} logs a row")
    left_out = {} if options.recordings else SLOW
    for name in options.only or [name for name in ROWS if name not in left_out]:
        for row in ROWS[name](bench):
            show(row)
    for name, why in () if options.only else left_out.items():
        print(f"left out: {name}, {why}: ask for it with --only {name}")


def small() -> Recordings:
    """Return simulated grasps of a small array: this is to run in seconds."""
    return simulate(10, SensorLayout(2, 8, 6), n_frames=60, seed=3)


if __name__ == "__main__":
    main()
