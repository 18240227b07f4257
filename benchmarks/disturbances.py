"""Rows of the benchmark in which nothing is broken, but something else happens to all cells, to a
pad or to the log: who is blamed, and is it told?

A log is 40 recordings, as in the rows of cells that move; it goes through
:func:`adaptfault.inspect` with the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from rows import IN_USE, Bench, Count, Tally, draw_faults, highest, rest_levels

import adaptfault as af
from adaptfault.bench.changes import STUCK_KINDS, Log, broken, parted
from adaptfault.inspection.result import OF_CELLS
from diagnostics import Monitor

BESIDE = 0.08  # share of the cells that are dead beside a disturbance
NOISE = 2 / 4095  # of full scale: that of the reference where it has none
SHORT = 12  # recordings of a log that are looked at one by one
Disturb = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def along(whole: np.ndarray) -> np.ndarray:
    """Return the share of the log that has passed at each frame, ``[T, 1]``."""
    return np.linspace(0, 1, len(whole))[:, None]


def noise_of(bench: Bench) -> float:
    """Return the noise of the reference: the standard deviation that the median step between two
    frames stands for, at least ``NOISE``."""
    frames = np.asarray(bench.recordings.frames[bench.reference[0]], dtype=np.float64)
    steps = np.abs(np.diff(frames, axis=0))
    return max(float(np.median(steps)) / 0.95, NOISE * bench.layout.full_scale)


def cases(bench: Bench) -> dict[str, Disturb]:
    """Return by name what happens to the readings ``[T, D]`` of a log."""
    layout = bench.layout
    span = highest(bench)
    rest = rest_levels(bench)
    noise = noise_of(bench)
    healthy = np.concatenate([bench.recordings.frames[i] for i in bench.reference])

    def idle(count: int, rng: np.random.Generator) -> np.ndarray:
        drawn = healthy[rng.integers(len(healthy), size=count)]
        return np.where(drawn - rest > 0.01 * span, rest, drawn)

    def hum(share: float) -> Disturb:
        def change(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            turns = np.arange(len(whole)) / rng.uniform(4, 20) + rng.uniform()
            return whole + share * span * np.sin(2 * np.pi * turns)[:, None]

        return change

    def one_pad_unused(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        seen = whole.copy()
        pad = np.flatnonzero(layout.pad_of == rng.integers(layout.pads))
        seen[:, pad] = idle(len(whole), rng)[:, pad]
        return seen

    def each_creeps(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return whole + along(whole) * rng.uniform(0, 0.08, whole.shape[1]) * span

    def ramp(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return whole + along(whole) * 0.15 * span

    def ages(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return rest + 0.06 * span * along(whole) + (whole - rest) * (1 - 0.2 * along(whole))

    def levels(count: int) -> Disturb:
        def change(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            step = span / count
            return np.floor(whole / step) * step

        return change

    def vibrates(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        turns = np.arange(len(whole))[:, None] / rng.uniform(3, 9)
        phase = rng.uniform(size=layout.pads)[layout.pad_of]
        swing = 0.02 * span * rng.uniform(0.5, 1.5, whole.shape[1])
        return idle(len(whole), rng) + swing * (1 + np.sin(2 * np.pi * (turns + phase)))

    def saturates(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.minimum(rest + 10 * (whole - rest), span)

    def crosstalk(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        seen = whole.copy()
        for pad in range(layout.pads):
            of_pad = np.flatnonzero((layout.pad_of == pad) & layout.present.ravel())
            seen[:, of_pad] += 0.5 * (whole - rest)[:, of_pad].mean(axis=1, keepdims=True)
        return seen

    def noisier(times: float) -> Disturb:
        def change(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            return whole + times * noise * rng.standard_normal(whole.shape)

        return change

    return {
        "hum of 1 %": hum(0.01),
        "hum of 3 %": hum(0.03),
        "hum of 6 %": hum(0.06),
        **({"one pad unused": one_pad_unused} if layout.pads > 1 else {}),
        "each cell creeps by 0 to 8 %": each_creeps,
        "a ramp to 15 %": ramp,
        "rest +6 %, gain -20 %": ages,
        "16 levels": levels(16),
        "8 levels": levels(8),
        "empty and vibrating": vibrates,
        "saturates at a tenth": saturates,
        "crosstalk of a pad": crosstalk,
        "noise x 5": noisier(5),
        "noise x 30": noisier(30),
    }


def read(whole: np.ndarray, bench: Bench) -> np.ndarray:
    """Return what a converter makes of readings: whole counts where the array has them."""
    full_scale = bench.layout.full_scale
    counts = np.rint(whole) if full_scale > 1 else whole
    return np.clip(counts, 0, full_scale)


def inspected(log: Log, bench: Bench) -> af.Inspection:
    """Return the inspection of a log with the reference."""
    reference = [bench.recordings.frames[i] for i in bench.reference]
    return af.inspect(log, bench.fitted, reference=reference)


def blamed_and_wires(inspection: af.Inspection) -> np.ndarray:
    """Return the number of cells in F, and of wires."""
    wires = sum(fault.line is not None for fault in inspection.diagnosis.faults)
    return np.array([len(inspection.diagnosis.fault_set), wires])


def is_told(inspection: af.Inspection) -> bool:
    """Return whether a finding speaks of the sensor, or of what was not tested."""
    of_cells = {*OF_CELLS} - {"untested"}
    return any(finding.name not in of_cells for finding in inspection.findings)


def disturbed(bench: Bench) -> Iterator[Count]:
    """Nothing is broken but all cells, or a pad, are disturbed; then 8 % of the cells are dead,
    too."""
    for case, change in cases(bench).items():
        wrong = np.zeros(2)
        told = 0
        tally = Tally()
        for seed, log, rng in bench.logs(IN_USE):
            seen = parted(read(change(np.concatenate(log), rng), bench), log)
            inspection = inspected(seen, bench)
            wrong += blamed_and_wires(inspection)
            told += is_told(inspection)
            faults = draw_faults(bench.layout, BESIDE, STUCK_KINDS, rng)
            dying = list(broken(seen, faults, bench.layout, 0.0, 0.0, seed))
            tally.add(seen, dying, faults, inspected(dying, bench).diagnosis, 0)
        yield Count(f"{case}: cells blamed in a log", wrong[0], bench.count, higher=False)
        yield Count(f"{case}: wires invented in a log", wrong[1], bench.count, higher=False)
        yield Count(f"{case}: told", told, bench.count)
        yield from tally.counts(f"{case}, 8 % dead")


def untested(bench: Bench) -> Iterator[Count]:
    """Noise of 1 to 30 times the reference's, and no contact: what counts as tested?"""
    rest = rest_levels(bench)
    sigma = noise_of(bench)
    tested = 0.0
    zero = logs = 0
    for _, log, rng in bench.logs(IN_USE):
        for times in (1, 3, 10, 30):
            noise = times * sigma * rng.standard_normal((sum(map(len, log)), len(rest)))
            inspection = inspected(parted(read(rest + noise, bench), log), bench)
            tested += inspection.diagnosis.coverage.test_coverage
            zero += inspection.severity == 0
            logs += 1
    yield Count("noise without contact: share tested", tested, logs, higher=False)
    yield Count("noise without contact: exit code 0", zero, logs, higher=False)


def offsets(bench: Bench) -> Iterator[Count]:
    """The same offset for all cells, from 0 to 8 % of full scale in steps of 0.1 %."""
    wrong = np.zeros(2)
    logs = 0
    for _, log, _ in bench.logs():
        for share in np.arange(0, 0.0801, 0.001):
            shifted = [read(f + share * bench.layout.full_scale, bench) for f in log]
            wrong += blamed_and_wires(inspected(shifted, bench))
            logs += 1
    yield Count("offset of 0 to 8 %: cells blamed in a log", wrong[0], logs, higher=False)
    yield Count("offset of 0 to 8 %: wires invented in a log", wrong[1], logs, higher=False)


def short(bench: Bench) -> Iterator[Count]:
    """Logs of one recording, of one frame a recording, and logs that end within a contact."""
    rest = rest_levels(bench)
    wrong = {name: np.zeros(2) for name in ("one recording", "one frame each", "cut in a contact")}
    logs = dict.fromkeys(wrong, 0)

    def judge(name: str, log: Log) -> None:
        wrong[name] += blamed_and_wires(inspected(log, bench))
        logs[name] += 1

    for _, log, _ in bench.logs(SHORT):
        peaks = [int((f - rest).sum(axis=1).argmax()) for f in log]
        judge("one frame each", [f[at : at + 1] for f, at in zip(log, peaks, strict=True)])
        for i, (frames, at) in enumerate(zip(log, peaks, strict=True)):
            judge("one recording", [frames])
            if i:
                judge("cut in a contact", [*log[:i], frames[: at + 1]])
    for name, (cells, wires) in wrong.items():
        yield Count(f"{name}: cells blamed in a log", cells, logs[name], higher=False)
        yield Count(f"{name}: wires invented in a log", wires, logs[name], higher=False)


def monitored(bench: Bench) -> Iterator[Count]:
    """Healthy streams of 40 recordings through the Monitor."""
    raised = 0
    for _, log, _ in bench.logs(IN_USE):
        monitor = Monitor(bench.fitted, wait=True)
        for frame in np.concatenate(log):
            raised += sum(fault.probability > 0 for fault in monitor.update(frame))
    yield Count("a healthy stream: alarms", raised, bench.count, higher=False)


ROWS = {row.__name__: row for row in (disturbed, untested, offsets, short, monitored)}
