"""The demonstration in one run: train, break the sensor, diagnose, adapt, write a report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.data.documents import members
from adaptfault.data.recordings import Recordings
from adaptfault.data.windows import Windows, make_windows, scale, split
from adaptfault.evaluation.scores import Scores, accuracy_interval
from adaptfault.models.history import History
from adaptfault.models.network import TactileTransformer
from adaptfault.models.training import train
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    FaultSet,
    SelfDiagnosis,
    SensorLayout,
    inject,
    line_fault,
)

_LOG_RECORDINGS = 20  # of the broken sensor, for the diagnosis
_SHOWN = 8  # faults printed of each list; the report has all


@dataclass(frozen=True, eq=False)
class DemoResult:
    """The results of the run.

    Attributes:
        recordings: the input.
        seed: of the whole run.
        injected: the known faults.
        fault_free, broken, repaired: scores of the test windows: healthy sensor; broken sensor and
        the fault-free
            model; broken sensor and the adapted model.
        intervals: 95 % of the accuracy of these three, clustered by recording.
        history: of training.
        diagnosis: of a log of the broken sensor.
        adaptation: what was done about it.
        n_log: recordings in that log.
        seconds: wall clock of each step.
        maps: mean forces ``[D]`` over the test recordings: "normal", "broken", "filled in".
    """

    recordings: Recordings
    seed: int
    injected: tuple[Fault, ...]
    fault_free: Scores
    broken: Scores
    repaired: Scores
    intervals: tuple[tuple[float, float], ...]
    history: History
    diagnosis: Diagnosis
    adaptation: Adaptation
    n_log: int
    seconds: dict[str, float]
    maps: dict[str, NDArray[np.float64]]

    @property
    def injected_set(self) -> FaultSet:
        """The cells that were broken."""
        cells = {c for fault in self.injected for c in fault.cells}
        return FaultSet(tuple(cells), self.recordings.layout.n_cells)

    @property
    def found(self) -> FaultSet:
        """Broken cells that the diagnosis found."""
        return self.diagnosis.fault_set & self.injected_set

    @property
    def false_alarms(self) -> FaultSet:
        """Healthy cells that the diagnosis called faulty."""
        return self.diagnosis.fault_set - self.injected_set

    @property
    def recovered(self) -> float:
        """Accuracy after repair as a share of the fault-free one."""
        return self.repaired.accuracy / max(self.fault_free.accuracy, 1e-12)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": "adaptfault.demo/1",
            **members(self, "seed", "injected", "fault_free", "broken", "repaired", "intervals"),
            **members(self, "recovered", "diagnosis", "false_alarms", "history", "seconds"),
            **members(self.recordings, "layout", "class_names"),
            **members(self.adaptation, "stages"),
            "recordings": len(self.recordings),
        }


def run_demo(
    recordings: Recordings,
    faults: Sequence[Fault] | None = None,
    *,
    epochs: int = 20,
    learning_rate: float = 1e-4,
    network: Mapping[str, Any] | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: bool | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> DemoResult:
    """Run the demonstration.

    Args:
        recordings: labelled and fault-free.
        faults: what to break; None: a row, a short, an open and a cell stuck in mid-range.
        epochs, learning_rate: of training; epochs at most.
        network: other options of the network, as ``padding``.
        seed: of the split, the weights, training and the faults.
        checkpoint: file from which training continues after a crash.
        progress: show or hide progress on stderr; None shows it on a terminal.
        say: called with each result as one line of text.

    Raises:
        ValueError: no labels, or too few recordings to split.
    """
    layout = recordings.layout
    if recordings.labels is None:
        raise ValueError("the recordings have no labels: the demo trains a classifier")
    seconds: dict[str, float] = {}
    windows = make_windows(recordings.frames, recordings.labels, layout)
    training, validation, test = split(windows, seed=seed)
    say(
        f"recordings   {len(recordings)} of {layout}; {len(recordings.class_names)} classes,"
        f" {len(windows)} windows"
    )
    model = TactileTransformer(layout, len(recordings.class_names), seed=seed, **(network or {}))
    options: dict[str, Any] = {"checkpoint": checkpoint, "progress": progress, "seed": seed}
    with _timed(seconds, "training"):
        history = train(
            model, training, validation, epochs=epochs, learning_rate=learning_rate, **options
        )
    say(f"training     {history}")
    adapter = Adapter(model, training, validation)
    result = _repaired(recordings, adapter, test, faults, history, seconds, seed, progress, say)
    say(f"repaired     {result.repaired}")
    say(_summary(result))
    return result


def _repaired(
    recordings: Recordings,
    adapter: Adapter,
    test: Windows,
    faults: Sequence[Fault] | None,
    history: History,
    seconds: dict[str, float],
    seed: int,
    progress: bool | None,
    say: Callable[[str], None],
) -> DemoResult:
    """Break the sensor, diagnose it, and repair the model of the adapter.

    Args:
        adapter: with the trained model.
        test: fault-free windows that it has not seen.
        history: of the training.
        seconds: of each step; the further steps are added.
        recordings, faults, seed, progress, say: as in :func:`run_demo`.
    """
    layout = recordings.layout
    rng = np.random.default_rng(seed)
    healthy = [recordings.frames[i] for i in np.unique(adapter.train.recording)]
    tested = np.unique(test.recording)
    deployed = adapter.healthy
    fault_free = _score(deployed, test)
    say(f"fault-free   {fault_free[0]}")
    injected = tuple(default_faults(healthy, layout, rng) if faults is None else faults)
    broken, broken_windows = _broken(recordings, tested, injected, seed)
    collapsed = _score(deployed, broken_windows)
    say(f"broken       {len({c for fault in injected for c in fault.cells})} cells; {collapsed[0]}")
    _list(say, [fault.describe(layout) for fault in injected])
    log = [broken[i] for i in rng.permutation(len(broken))[:_LOG_RECORDINGS]]
    with _timed(seconds, "fitting the healthy model"):
        diagnoser = SelfDiagnosis(layout).fit(healthy)
    with _timed(seconds, "diagnosis"):
        diagnosis = diagnoser.diagnose(log)
    say(_found(diagnosis, injected, len(log), seconds["diagnosis"]))
    _list(say, [fault.reason for fault in diagnosis.faults])
    with _timed(seconds, "adaptation"):
        adaptation = adapter.adapt(diagnosis.fault_set, seed=seed, progress=progress)
    for stage in adaptation.stages:
        say(f"adaptation   {stage}")
    repaired = _score(adaptation, broken_windows)
    return DemoResult(
        recordings=recordings,
        seed=seed,
        injected=injected,
        fault_free=fault_free[0],
        broken=collapsed[0],
        repaired=repaired[0],
        intervals=(fault_free[1], collapsed[1], repaired[1]),
        history=history,
        diagnosis=diagnosis,
        adaptation=adaptation,
        n_log=len(log),
        seconds=seconds,
        maps=_force_maps([recordings.frames[i] for i in tested], broken, adaptation, layout),
    )


def _broken(
    recordings: Recordings, which: NDArray[np.int64], faults: Sequence[Fault], seed: int
) -> tuple[list[NDArray[np.float64]], Windows]:
    """Return some of the recordings with the faults in them, and their windows, labelled."""
    layout = recordings.layout
    broken = [inject(recordings.frames[i], faults, layout, seed=seed + int(i)) for i in which]
    return broken, _labelled(make_windows(broken, None, layout), which, recordings)


def _summary(result: DemoResult) -> str:
    """Return the accuracy before the faults, with them, and after the repair, in one line."""
    steps = {"fault-free": result.fault_free, "broken": result.broken, "repaired": result.repaired}
    sequence = " -> ".join(f"{scores.accuracy:.3f} {name}" for name, scores in steps.items())
    return (
        f"accuracy     {sequence} ({result.recovered:.0%} of fault-free) in"
        f" {result.seconds['adaptation']:.1f} s"
    )


def _list(say: Callable[[str], None], lines: Sequence[str]) -> None:
    for line in lines[:_SHOWN]:
        say(f"             {line}")
    if len(lines) > _SHOWN:
        say(f"             and {len(lines) - _SHOWN} more")


def _found(diagnosis: Diagnosis, injected: Sequence[Fault], n_log: int, seconds: float) -> str:
    """Return the number of injected faults that were found, and of those that the log cannot
    show."""
    true = {cell for fault in injected for cell in fault.cells}
    false = len(diagnosis.fault_set - true)
    missed = len(true & set(diagnosis.coverage.untested.tolist()))
    logs = "1 recording" if n_log == 1 else f"{n_log} recordings"
    untested = f" ({missed} not tested by the log)" if missed else ""
    return (
        f"diagnosis    found {len(diagnosis.fault_set & true)} of {len(true)} broken"
        f" cells{untested}, {false} false alarm{'' if false == 1 else 's'}, from {logs} in"
        f" {seconds:.2f} s; {diagnosis.coverage}"
    )


def default_faults(
    recordings: Sequence[NDArray[Any]], layout: SensorLayout, rng: np.random.Generator
) -> list[Fault]:
    """Draw a broken row, a short, an open and a cell stuck in mid-range, where the recordings show
    contact.

    On an array without three cells besides the row, what still finds a place is returned.
    """
    touched = np.mean(
        [np.nan_to_num(r).max(axis=0) > 0.02 * layout.full_scale for r in recordings], axis=0
    )
    rows = [line for line in layout.lines if line.kind == "row" and len(layout.cells_on(line))]
    activity = np.array([touched[layout.cells_on(line)].mean() for line in rows])
    busy = np.flatnonzero(activity >= np.quantile(activity, 0.75))
    faults = [line_fault(layout, rows[int(rng.choice(busy))], FaultKind.OPEN)]
    others = np.setdiff1d(np.flatnonzero(layout.present), faults[0].cells)
    busiest = rng.permutation(others[np.argsort(-touched[others])][: max(3, len(others) // 2)])
    for cell, kind in zip(
        busiest, (FaultKind.SHORT, FaultKind.OPEN, FaultKind.STUCK), strict=False
    ):
        value = layout.full_scale / 2 if kind is FaultKind.STUCK else None
        faults.append(Fault(kind, (int(cell),), value=value))
    return faults


def _score(
    model: TactileTransformer | Adaptation, windows: Windows
) -> tuple[Scores, tuple[float, float]]:
    """Return scores and the 95 % interval of the accuracy."""
    predicted = model.predict(windows.x)
    return Scores.of(windows.y, predicted), accuracy_interval(
        predicted == windows.y, windows.recording
    )


def _labelled(windows: Windows, which: NDArray[np.int64], recordings: Recordings) -> Windows:
    """Give windows, numbered within a selection of recordings, the labels and numbers of those
    recordings."""
    assert recordings.labels is not None
    recording = which[windows.recording]
    return Windows(windows.x, recordings.labels[recording], recording)


def _force_maps(
    normal: Sequence[NDArray[Any]],
    broken: Sequence[NDArray[Any]],
    adaptation: Adaptation,
    layout: SensorLayout,
) -> dict[str, NDArray[np.float64]]:
    """Return mean forces ``[D]`` of the healthy sensor, of the broken one, and after imputation."""
    import torch

    from adaptfault.adaptation.reduced_model import phi
    from adaptfault.data.windows import hold_missing

    frames = hold_missing(np.concatenate([scale(r, layout) for r in broken]))
    with torch.no_grad():
        filled = adaptation.model.complete(
            torch.from_numpy(phi(frames, adaptation.fault_set))[None]
        )[0].numpy()
    return {
        "normal": np.nanmean(np.concatenate(normal), axis=0, dtype=np.float64),
        "broken": np.nanmean(np.concatenate(broken), axis=0),
        "filled in": filled.mean(axis=0, dtype=np.float64) * layout.full_scale,
    }


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Add the wall clock of a step."""
    began = time.perf_counter()
    yield
    seconds[step] = time.perf_counter() - began
