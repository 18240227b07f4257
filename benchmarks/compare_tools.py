"""SelfDiagnosis beside public tools on the same logs: python benchmarks/compare_tools.py
[RECORDINGS] [--plot FILE]

Half of the recordings are the fault-free reference. Logs of six recordings from the other half get
random dead cells (16 %: open, short, or stuck at any value, a third each), from the first frame or
from 60 % of the log on; the same logs unbroken show the false alarms. A dead cell is testable if
what it hides differs from what it reads by over 5 % of full scale in at least 10 frames. Without
RECORDINGS: simulated grasps.

The tools were made for electrodes, cameras and tables, so each one runs twice: as shipped, and with
whichever setting does best (F1) on logs of the reference with known faults. SelfDiagnosis has no
setting, but the home advantage: it was developed on such logs, and learns what evidence is worth by
breaking the reference itself. --split 1 deals the recordings anew.

    pip install 'adaptfault[compare]'    # the public tools; those that are missing are skipped
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from rows import draw_faults

from adaptfault.bench.changes import broken
from adaptfault.data.recordings import Recordings, load
from adaptfault.data.simulated_grasps import simulate
from diagnostics import SelfDiagnosis, SensorLayout

SHARE = 0.16
ONSETS = {"16 % dead": 0.0, "from 60 % of it on": 0.6}
TUNING_LOGS = 6


@dataclass(frozen=True)
class Known:
    """What a tool may ask for besides the log."""

    layout: SensorLayout
    healthy: np.ndarray  # [T, D], the fault-free reference

    @property
    def present(self) -> np.ndarray:
        """The cells that exist, ascending."""
        return np.flatnonzero(self.layout.present)

    @property
    def positions(self) -> np.ndarray:
        """Pad, row, column of each present cell, ``[n, 3]``."""
        return np.array([self.layout.position(cell) for cell in self.present])


def logs(
    recordings: Recordings, which: np.ndarray, count: int
) -> Iterator[tuple[list[np.ndarray], np.random.Generator]]:
    for seed in range(count):
        rng = np.random.default_rng(seed)
        yield (
            [recordings.frames[i] for i in rng.choice(which, min(6, len(which)), replace=False)],
            rng,
        )


Find = Callable[[list[np.ndarray]], Iterable[int | str]]  # log -> cells it calls dead
# known, setting, log -> the same
Tool = Callable[[Known, float, list[np.ndarray]], Iterable[int | str]]


def as_mne(log: list[np.ndarray], known: Known):
    """Return the log as EEG. MNE and pyprep put electrodes on a sphere: each pad gets a slice of
    it, like orange peel.

    Rows run along 120 degrees of latitude, columns across 80 % of the slice.
    """
    import mne

    mne.set_log_level("error")
    layout = known.layout
    names = [str(cell) for cell in known.present]
    pad, row, col = known.positions.T
    latitude = np.radians(120) * ((row + 0.5) / layout.rows - 0.5)
    longitude = 2 * np.pi / layout.pads * (pad + 0.8 * ((col + 0.5) / layout.cols - 0.5))
    sphere = [
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
    ]
    volts = np.concatenate(log)[:, known.present].T / layout.full_scale
    raw = mne.io.RawArray(volts, mne.create_info(names, layout.rate, "eeg"))
    head = dict(zip(names, 0.095 * np.transpose(sphere), strict=True))  # metres
    return raw.set_montage(mne.channels.make_dig_montage(head, coord_frame="head"))


def mne_flat(known: Known, percent: float, log: list[np.ndarray]) -> list[str]:
    from mne.preprocessing import annotate_amplitude

    return annotate_amplitude(as_mne(log, known), flat=0, bad_percent=percent)[1]


def mne_lof(known: Known, threshold: float, log: list[np.ndarray]) -> list[str]:
    from mne.preprocessing import find_bad_channels_lof

    return find_bad_channels_lof(as_mne(log, known), threshold=threshold)


def pyprep_ransac(known: Known, correlation: float, log: list[np.ndarray]) -> list[str]:
    """Flat channels count as found: pyprep takes them out before it predicts the others."""
    from pyprep import NoisyChannels

    noisy = NoisyChannels(as_mne(log, known), random_state=0)
    noisy.find_bad_by_ransac(corr_thresh=correlation)
    return noisy.get_bads()


def spikeinterface_r2(known: Known, r2: float, log: list[np.ndarray]) -> Iterable[str]:
    """Cells 20 um apart and the default radius of 30 um make 8 neighbours.

    The correlation is taken over the whole log at once: chunks of 0.3 s, the default, are 3 to 10
    frames here.
    """
    from spikeinterface import NumpyRecording
    from spikeinterface.preprocessing import detect_bad_channels

    layout = known.layout
    frames = np.concatenate(log)[:, known.present]
    pad, row, col = known.positions.T
    recording = NumpyRecording([frames], layout.rate, channel_ids=known.present.astype(str))
    recording.set_dummy_probe_from_locations(
        20.0 * np.column_stack([col + pad * (layout.cols + 10), row])
    )
    recording.annotate(is_filtered=True)  # else it applies a high-pass of 300 Hz
    return detect_bad_channels(
        recording,
        method="neighborhood_r2",
        neighborhood_r2_threshold=r2,
        chunk_duration_s=len(frames) / layout.rate,
        num_random_chunks=1,
        seed=0,
    )[0]


def ccdproc_mask(known: Known, sigma: float, log: list[np.ndarray]) -> Iterable[int]:
    """Each pad is an image: mean frame of the log over mean frame of the reference, 1 where there
    is no cell."""
    from astropy.nddata import CCDData
    from ccdproc import ccdmask

    mean, expected = np.concatenate(log).mean(axis=0), known.healthy.mean(axis=0)
    ratio = np.divide(mean, expected, out=np.ones(known.layout.n_cells), where=expected > 0)
    pads = [CCDData(pad, unit="") for pad in known.layout.grid(ratio)]
    mask = np.ravel([ccdmask(pad, lsigma=sigma, hsigma=sigma) for pad in pads])
    return known.present[mask[known.present]]


def pyod_lof(known: Known, neighbours: float, log: list[np.ndarray]) -> Iterable[int]:
    """Five figures of each cell, less those of the reference. LOF marks the share it is told, in
    healthy logs too."""
    from pyod.models.lof import LOF
    from pyod.utils.utility import standardizer

    def features(frames: np.ndarray) -> np.ndarray:  # [T, D] -> [D, 5]
        x = frames / known.layout.full_scale
        still = (np.diff(x, axis=0) == 0).mean(axis=0)
        return np.column_stack([x.min(axis=0), x.max(axis=0), x.mean(axis=0), x.std(axis=0), still])

    x = (features(np.concatenate(log)) - features(known.healthy))[known.present]
    return known.present[
        LOF(n_neighbors=int(neighbours), contamination=SHARE).fit(standardizer(x)).labels_ == 1
    ]


@dataclass(frozen=True)
class Peer:
    """A public tool, the one setting to vary (the default comes first), and what it is told besides
    the log."""

    name: str
    package: str
    call: Tool
    setting: str
    values: tuple[float, ...]
    told: str = "the log only"


PEERS = (
    Peer("MNE flat", "mne", mne_flat, "bad_percent", (5, 50, 80, 90, 95, 99, 100)),
    Peer("MNE LOF", "mne", mne_lof, "threshold", (1.5, 1.1, 1.2, 1.3, 2, 3)),
    Peer("pyprep RANSAC", "pyprep", pyprep_ransac, "corr_thresh", (0.75, 0.5, 0.25, 0.0, -0.5)),
    Peer(
        "SpikeInterface r2",
        "spikeinterface",
        spikeinterface_r2,
        "threshold",
        (0.9, 0.7, 0.5, 0.25, 0.1, 0.02),
    ),
    Peer(
        "ccdproc ccdmask", "ccdproc", ccdproc_mask, "sigma", (9, 4, 6, 12, 15, 20, 30), "reference"
    ),
    Peer(
        "PyOD LOF",
        "pyod",
        pyod_lof,
        "n_neighbors",
        (20, 35, 50, 70),
        "reference, share of dead cells",
    ),
)


@dataclass(frozen=True)
class Log:
    """A log and the truth about it."""

    recordings: list[np.ndarray]
    dead: frozenset[int]
    testable: frozenset[int]


@dataclass
class Tally:
    """What one tool found in some logs."""

    true: int = 0
    false: int = 0
    hit: int = 0
    testable: int = 0
    seconds: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    @property
    def precision(self) -> float:
        """Share of what it called dead that is dead; NaN if it called nothing dead."""
        return self.true / (self.true + self.false) if self.true + self.false else float("nan")

    @property
    def recall(self) -> float:
        """Share of the testable dead cells that it found."""
        return self.hit / max(self.testable, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of the two."""
        return 2 / (1 / self.precision + 1 / self.recall) if self.hit else 0.0


@dataclass(frozen=True)
class Row:
    """A tool, how it was set, what it was told, and what it reached in each case."""

    name: str
    setting: str
    told: str
    cases: dict[str, Tally]
    alarms: float  # per 1000 healthy cells of healthy logs

    @property
    def milliseconds(self) -> float:
        """Median of the logs on which it did not fail."""
        seconds = [s for reached in self.cases.values() for s in reached.seconds]
        return 1000 * float(np.median(seconds)) if seconds else float("nan")

    def better_than(self, ours: Row) -> list[str]:
        """Return in what this tool beats SelfDiagnosis, and at what price."""
        won = []
        for case, mine in self.cases.items():
            theirs = ours.cases[case]
            if mine.precision > theirs.precision:
                won.append(
                    f"precision, {case}: {mine.precision:.3f} (with recall {mine.recall:.3f})"
                )
            if mine.recall > theirs.recall:
                won.append(
                    f"recall, {case}: {mine.recall:.3f} (with precision {mine.precision:.3f})"
                )
        won += [f"false alarms: {self.alarms:.1f}"] if self.alarms < ours.alarms else []
        won += (
            [f"time: {self.milliseconds:.0f} ms"] if self.milliseconds < ours.milliseconds else []
        )
        return won


def make_logs(
    recordings: Recordings, which: np.ndarray, count: int, share: float, onset: float
) -> list[Log]:
    layout = recordings.layout
    made = []
    for seed, (log, rng) in enumerate(logs(recordings, which, count)):
        faults = draw_faults(layout, share, ("open", "short", "stuck"), rng)
        seen = list(broken(log, faults, layout, onset, 0.0, seed))
        hidden = np.abs(np.concatenate(seen) - np.concatenate(log)) > 0.05 * layout.full_scale
        testable = np.flatnonzero(hidden.sum(axis=0) >= 10).tolist()
        made.append(Log(seen, frozenset(c for f in faults for c in f.cells), frozenset(testable)))
    return made


def tally(find: Find, cases: list[Log]) -> Tally:
    """Run a tool on logs. One on which it fails counts as a log in which it found nothing."""
    result = Tally()
    for log in cases:
        found: set[int] = set()
        began = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what the tools warn about themselves
                found = {int(cell) for cell in find(log.recordings)}
            result.seconds.append(time.perf_counter() - began)
        except Exception as error:
            result.errors.append(f"{type(error).__name__}: {error}")
        result.true, result.false = (
            result.true + len(found & log.dead),
            result.false + len(found - log.dead),
        )
        result.hit, result.testable = (
            result.hit + len(found & log.testable),
            result.testable + len(log.testable),
        )
    return result


def compare(recordings: Recordings, peers: list[Peer], count: int, split: int) -> list[Row]:
    layout = recordings.layout
    order = np.random.default_rng(split).permutation(len(recordings))
    reference = order[: len(order) // 2]
    rest = order[len(order) // 2 :]
    healthy = [recordings.frames[i] for i in reference]
    known = Known(layout, np.concatenate(healthy))
    cases = {
        name: make_logs(recordings, rest, count, SHARE, onset) for name, onset in ONSETS.items()
    }
    unbroken = make_logs(recordings, rest, count, 0.0, 0.0)
    tuning = [
        log
        for onset in ONSETS.values()
        for log in make_logs(recordings, reference, TUNING_LOGS, SHARE, onset)
    ]

    def row(name: str, setting: str, told: str, find: Find) -> Row:
        quiet = tally(find, unbroken)
        found = {case: tally(find, broken_logs) for case, broken_logs in cases.items()}
        for case, errors in (
            ("healthy", quiet.errors),
            *((case, t.errors) for case, t in found.items()),
        ):
            if errors:
                print(
                    f"{name}, {setting}: failed on {len(errors)} of {count} logs ({case}):"
                    f" {errors[0]}"
                )
        cells = len(quiet.seconds) * len(known.present)
        return Row(
            name, setting, told, found, 1000 * quiet.false / cells if cells else float("nan")
        )

    fitted = SelfDiagnosis(layout).fit(healthy)
    rows = [
        row("SelfDiagnosis", "fitted", "reference", lambda log: fitted.diagnose(log).fault_set),
        row(
            "SelfDiagnosis",
            "not fitted",
            "the log only",
            lambda log: SelfDiagnosis(layout).diagnose(log).fault_set,
        ),
    ]
    for peer in peers:
        finds = {value: partial(peer.call, known, value) for value in peer.values}
        best = max(finds, key=lambda value: tally(finds[value], tuning).f1)
        for value in dict.fromkeys((peer.values[0], best)):
            how = ", ".join(["default"] * (value == peer.values[0]) + ["best"] * (value == best))
            rows.append(
                row(peer.name, f"{peer.setting} {value:g} ({how})", peer.told, finds[value])
            )
    return rows


def show(rows: list[Row]) -> None:
    cases = rows[0].cases
    print(f"\n{'':52s}" + "".join(f"{case:^22s}" for case in cases) + f"{'false alarms':>14s}")
    print(
        f"{'':52s}"
        + f"{'precision':>12s}{'recall':>10s}" * len(cases)
        + f"{'per 1000':>14s}{'ms a log':>10s}  told"
    )
    for row in rows:
        reached = "".join(
            f"{case.precision:12.3f}{case.recall:10.3f}" for case in row.cases.values()
        )
        print(
            f"{row.name:19s}{row.setting:33s}{reached}{row.alarms:14.1f}{row.milliseconds:10.0f} "
            f" {row.told}"
        )
    print(
        "\nRecall is of the testable dead cells, false alarms are per 1000 healthy cells of healthy"
        " logs."
    )
    print("Better than the fitted SelfDiagnosis:")
    for row in rows[1:]:
        print(f"  {row.name}, {row.setting}: {'; '.join(row.better_than(rows[0])) or 'in nothing'}")


def plot(rows: list[Row], path: Path) -> None:
    from matplotlib.figure import Figure

    cases = list(rows[0].cases)
    figure = Figure(figsize=(12, 1.5 + 0.35 * len(rows)), layout="constrained")
    *axes, alarms = figure.subplots(1, len(cases) + 1, sharey=True)
    y = np.arange(len(rows))
    for axis, case in zip(axes, cases, strict=True):
        axis.barh(y - 0.2, [row.cases[case].precision for row in rows], 0.4, label="precision")
        axis.barh(
            y + 0.2, [row.cases[case].recall for row in rows], 0.4, label="recall of the testable"
        )
        axis.set(title=case, xlim=(0, 1))
    axes[0].set_yticks(y, [f"{row.name} {row.setting}" for row in rows])
    axes[0].invert_yaxis()
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False
    )
    alarms.barh(y, [row.alarms for row in rows], 0.6, color="tab:red")
    alarms.set(title="false alarms per 1000 cells", xscale="symlog", xlim=(0, 1000))
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="SelfDiagnosis beside public tools on the same logs"
    )
    parser.add_argument(
        "recordings", nargs="?", help="fault-free recordings; without: simulated grasps"
    )
    parser.add_argument("--logs", type=int, default=2, help="logs a case (default 2)")
    parser.add_argument("--split", type=int, default=0, help="seed of the halves (default 0)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the table as a PNG")
    options = parser.parse_args()
    recordings = load(options.recordings).recordings if options.recordings else simulate(10, seed=3)
    print(
        f"{len(recordings)} recordings of {recordings.layout}, split {options.split};"
        f" {options.logs} logs a case"
    )
    peers = []
    for peer in PEERS:
        try:
            print(f"{peer.name}: {peer.package} {version(peer.package)}")
            peers.append(peer)
        except PackageNotFoundError:
            print(
                f"{peer.name}: skipped, {peer.package} is missing: pip install"
                " 'adaptfault[compare]'"
            )
    rows = compare(recordings, peers, options.logs, options.split)
    show(rows)
    if options.plot:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
