"""What a user writes; test_typed.py checks its types as strictly as mypy can."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import adaptfault as af
from diagnostics import Diagnosis, Fault, FaultSet, Monitor, SelfDiagnosis, inject


def trained(grasps: af.Recordings) -> tuple[af.Adapter, af.Windows]:
    windows = af.make_windows(grasps.frames, grasps.labels, grasps.layout)
    training, validation, test = af.split(windows)
    model = af.TactileTransformer(grasps.layout, len(grasps.class_names))
    history = af.train(model, training, validation, epochs=1, progress=False)
    print(history.best_accuracy + 0.5)
    return af.Adapter(model, training, validation), test


def diagnosed(grasps: af.Recordings, folder: Path) -> Diagnosis:
    diagnoser = SelfDiagnosis(grasps.layout).fit(grasps.frames)
    diagnoser.save(folder / "fit.npz")
    log = [inject(frames, [Fault("open", (3,)), 7], grasps.layout) for frames in grasps.frames]
    diagnosis = SelfDiagnosis.load(folder / "fit.npz").diagnose(log)
    table = diagnosis.to_dataframe()
    print(len(table), diagnosis.false_share + 0.5, diagnosis.coverage.advice[:1])
    if (certificate := diagnoser.certificate_) is not None:
        print(certificate.false_alarms + 0.5)
    return diagnosis


def watched(
    diagnoser: SelfDiagnosis, frames: np.ndarray[tuple[int, int], np.dtype[np.float64]]
) -> int:
    monitor = Monitor(diagnoser)
    told: list[str] = []
    for frame in frames:
        told += [fault.reason for fault in monitor.update(frame)]
    told += [fault.reason for fault in monitor.flush()]
    return len(told) + len(monitor.faults)


def repaired(adapter: af.Adapter, faulty: FaultSet | list[int], test: af.Windows) -> float:
    forecast = adapter.forecast(faulty)
    adaptation = adapter.adapt(faulty, method="head", progress=False)
    sets = adaptation.prediction_sets(test.x, alpha=0.1)
    certain = sets.sum(axis=1) == 1
    print(forecast.n_recordings, certain.mean(), adaptation.by_class.min())
    return adaptation.accuracy


def streamed(bundle: Path, frame: NDArray[np.float64]) -> str | None:
    reading = af.Predictor.load(bundle).stream(frame)
    for fault in reading.faults:
        print(fault.kind, fault.cells)
    return reading.name


def restored(grasps: af.Recordings) -> float:
    restorer = af.Restorer(grasps.layout).fit(list(grasps.frames))
    whole, deviation = restorer.transform(grasps.frames[0], [3, 7], return_std=True)
    imputed = af.CellImputer([3]).fit_transform(grasps.frames[0])
    return float(whole.mean() + deviation.mean() + imputed.mean())


def maintained(path: Path, grasps: af.Recordings) -> int:
    report = af.maintain(af.Bundle.open(path), list(grasps.frames), dry_run=True)
    inspection = af.inspect(list(grasps.frames), SelfDiagnosis(grasps.layout))
    routine = af.plan_selftest(af.Bundle.open(path), grasps, n=4)
    return report.exit_code + inspection.severity + len(routine.recordings)
