"""Replays every power cut of a bundle's writes: power_cut.py [--all]

Every write, rename, removal, fsync and directory sync of a save, a maintenance run, a confirmation,
a rollback and a recording is noted. For every prefix of these steps, every state of the disk is
built that POSIX allows after a power cut: what was not synced may be there, be lost, or be there in
part, in any order. After each state the bundle must open, predict as one of the two versions, and
take the next confirmation; what was acknowledged must be there. The bundle is signed where
cryptography is installed: what runs must be signed in each state. Without ``--all`` a fixed-seed
sample of the states is checked.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from disk.power_cut_states import Trace, Tree, build

from diagnostics import FaultSet, Line, SelfDiagnosis, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(1, 4, 4)
CLASSES = ("nothing", "softer", "harder")
ROW = line_fault(LAYOUT, Line(0, "row", 1), "short")
NAME = "robot.bundle"


def linear(layout: SensorLayout, n_classes: int, length: int) -> Any:
    """Return the smallest classifier: one linear layer."""
    from torch import nn

    return nn.Sequential(nn.Flatten(1), nn.Linear(length * layout.n_cells, n_classes))


@contextmanager
def small_versions() -> Iterator[None]:
    """Leave out the export and most of the fit, which take seconds and write nothing of their own,
    and allow the model above."""
    import adaptfault as af

    af.allow_model("power_cut:linear")
    absent = ImportError("left out here")
    with (
        mock.patch.multiple(
            "adaptfault.prediction.export",
            add_onnx=mock.Mock(side_effect=absent),
            graph_of=mock.Mock(side_effect=absent),
        ),
        mock.patch("diagnostics.model.predictor._STEPS", 100),
        mock.patch("diagnostics.model.fitting._LOGS", 8),
    ):
        yield


@dataclass(frozen=True)
class Keys:
    """Who signs the bundle, and whom the robot trusts.

    Attributes:
        private: PEM file of the key that signs; None: it is not signed.
        trusted: PEM files of the public keys, as ``Bundle.open`` takes them.
    """

    private: Path | None = None
    trusted: tuple[Path, ...] | None = None

    @classmethod
    def written(cls, folder: Path) -> Keys:
        """Write a new key into a folder; none where cryptography is not installed."""
        try:
            from cryptography.hazmat.primitives import serialization as to
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        except ImportError:
            return cls()
        path = folder / "private.pem"
        key = Ed25519PrivateKey.generate()
        path.write_bytes(
            key.private_bytes(to.Encoding.PEM, to.PrivateFormat.PKCS8, to.NoEncryption())
        )
        return cls(path, (path,))  # a private key stands for its public one


def make(folder: Path, sign: Path | None = None) -> Any:
    """Return a new bundle of a linear classifier in ``folder``; ``sign``: the key that signs
    it."""
    import torch

    import adaptfault as af

    grasps = af.simulate(20, LAYOUT, n_frames=40, seed=1, classes=CLASSES)
    windows = af.make_windows(grasps.frames, grasps.labels, LAYOUT)
    training, validation, test = af.split(windows)
    torch.manual_seed(0)
    model = af.build_model("power_cut:linear", LAYOUT, len(CLASSES))
    af.train(model, training, validation, epochs=40, learning_rate=0.01, progress=False)
    adapter = af.Adapter(model, training, validation, layout=LAYOUT)
    diagnoser = SelfDiagnosis(LAYOUT).fit(grasps.frames)
    return af.Bundle.create(
        folder / NAME, adapter.model, adapter, diagnoser, check=test, class_names=CLASSES, sign=sign
    )


def broken_log(seed: int = 9) -> list[Any]:
    """Return recordings in which a row reads full scale."""
    import adaptfault as af

    grasps = af.simulate(6, LAYOUT, n_frames=40, seed=seed, classes=CLASSES[1:])
    return [inject(frames, [ROW], LAYOUT) for frames in grasps.frames]


def predictions(bundle: Any) -> tuple[Any, dict[int, Any]]:
    """Return windows on which versions 1 and 2 differ, and the classes that each gives them."""
    import adaptfault as af

    x = bundle.parts.check_windows().x
    x[..., list(ROW.cells)] = 1
    expected = {
        number: af.Adaptation.load(bundle.versions.path(number)).predict(x) for number in (1, 2)
    }
    assert (expected[1] != expected[2]).any()
    return x, expected


@dataclass(frozen=True)
class Operation:
    """A traced operation and what holds after it.

    Attributes:
        name: for the table.
        trace: its steps.
        versions: numbers of the versions that may run after a power cut, the one after the
            operation last.
        probation: whether the version is on probation after it.
        runs: what the journal holds after it.
        next: decisions that the next maintenance run with the broken row may make.
    """

    name: str
    trace: Trace
    versions: tuple[int, ...]
    probation: bool = False
    runs: tuple[str, ...] = ()
    next: tuple[str, ...] = ("unchanged", "deployed")


def operations(home: Path, keys: Keys) -> Iterator[Operation]:
    """Make a bundle and trace each operation on it; call within :func:`small_versions`."""
    import adaptfault as af
    from adaptfault.bundle.versions import Versions

    trace = Trace(home)
    with trace.recording():
        bundle = make(home, keys.private)
    yield Operation("save", trace, (1,))
    trace = Trace(home)
    with trace.recording():
        report = af.maintain(bundle, broken_log(), sign=keys.private)
    assert report.decision == "deployed", report
    yield Operation("maintain", trace, (1, 2), True, ("deployed",))
    trace = Trace(home)
    with trace.recording():
        bundle.confirm()
    yield Operation("confirm", trace, (2,), False, ("deployed", "confirmed"))
    adapter = bundle.parts.adapter()
    for cell in range(5):
        adaptation = adapter.adapt(FaultSet((cell,), LAYOUT.n_cells), method="fill", progress=False)
        bundle.write_version(adaptation, {})
    trace = Trace(home)
    keep = {1, 2, 6, 7}
    with trace.recording():
        Versions(bundle.path / "versions").sweep(keep)
    yield Operation("removal of old versions", trace, (2,), False, ("deployed", "confirmed"))
    trace = Trace(home)
    with trace.recording():
        bundle.rollback()
    yield Operation(
        "rollback",
        trace,
        (2, 1),
        False,
        ("deployed", "confirmed", "rollback"),
        ("unchanged", "kept", "deployed"),
    )


def check(
    operation: Operation,
    tree: Tree,
    complete: bool,
    home: Path,
    expected: dict[int, Any],
    x: Any,
    keys: Keys,
) -> None:
    """Raise AssertionError where a robot that starts from this state, and trusts these keys, is not
    right."""
    import adaptfault as af
    from adaptfault.bundle.pointer import Pointer

    build(tree, home)
    path = home / NAME
    if not path.exists():
        assert operation.name == "save", "there is no bundle"
        assert not complete, "there is no bundle, the operation was done"
        return
    before = Pointer.read(path)
    if complete:
        assert before.active == operation.versions[-1], (
            f"version {before.active} runs, the operation was done"
        )
        assert before.probation == operation.probation, (
            f"probation is {before.probation}, the operation was done"
        )
        runs = tuple(run["what"] for run in af.Bundle.open(path).journal.runs())
        assert runs == operation.runs, f"the journal holds {runs}, expected {operation.runs}"
    predictor = af.Predictor.load(path, keys=keys.trusted)
    assert predictor.version in operation.versions, f"version {predictor.version} runs"
    assert predictor.version == before.active, (
        f"version {before.active} was active, {predictor.version} runs"
    )
    assert (predictor.predict(x) == expected[predictor.version]).all(), "it predicts otherwise"
    assert predictor.confirm(), "the version cannot be confirmed"
    bundle = af.Bundle.open(path, keys=keys.trusted)
    assert bundle.active().number == predictor.version, "the confirmation changed the version"
    problems = [text for text in damage(bundle) if "is readable" not in text]
    assert not problems, f"damage: {problems}"
    report = af.maintain(bundle, broken_log(), sign=keys.private)
    assert report.decision in operation.next, f"the next maintenance run: {report}"
    assert report.fault_set == set(ROW.cells), f"the next maintenance run: {report}"
    assert not damage(bundle), f"damage after it: {damage(bundle)}"
    again = af.Bundle.open(path, keys=keys.trusted)
    assert again.active().number == report.version, "what the next run deployed does not run"


def damage(bundle: Any) -> list[str]:
    """Return what is damaged; a version that was not deployed yet is not signed, and runs
    nowhere."""
    return [text for text in bundle.problems() if "is not signed" not in text]


class _AtOnce:
    """Runs what a recorder gives to its thread at once, so that the order of steps is always the
    same."""

    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(call(*args))
        return done

    def shutdown(self) -> None:
        """Nothing is left to wait for."""


def traced_recording(home: Path) -> tuple[Trace, np.ndarray]:
    """Return the steps of two recordings of one device, and their frames."""
    from adaptfault.acquisition import Recorder

    frames = np.round(np.random.default_rng(0).uniform(0, 5, (400, LAYOUT.n_cells)), 3)
    trace = Trace(home)
    with (
        trace.recording(),
        Recorder(home / "robot" / "today", LAYOUT, "hand", interval=0.0) as recorder,
    ):
        recorder._disk.shutdown()
        recorder._disk = _AtOnce()
        for i, frame in enumerate(frames):
            if i % 50:  # synced every 50 frames
                recorder._synced = float("inf")
            else:
                recorder._synced = 0.0
            recorder.write(frame, i / LAYOUT.rate + (5 if i >= 250 else 0))
    return trace, frames


def check_recording(tree: Tree, complete: bool, home: Path, frames: np.ndarray) -> None:
    """Raise AssertionError where a line that is on the disk is lost, or one that never was is
    read."""
    import adaptfault as af

    build(tree, home)
    whole = cut = 0
    for path, data in sorted(tree.items()):
        if path.endswith(".csv") and data is not None:
            whole += data.partition(b"\0")[0].count(b"\n")
            # perhaps within the last number of a line
            cut += not data.endswith(b"\n") and b"\0" not in data
    if complete:
        assert whole == len(frames), (
            f"{whole} of {len(frames)} frames are there after the end of the recording"
        )
    if not whole:
        return
    read = np.concatenate(af.load(home / "robot" / "today", layout=LAYOUT).recordings.frames)
    assert whole <= len(read) <= whole + cut, f"{len(read)} of {whole} frames are read"
    right = frames.astype(np.float32)[: len(read)]
    assert (read == right).all(axis=1).sum() >= whole, "a frame is read that never was"


def run(
    *, sample: int | None, home: Path, say: Callable[[str], None] = print
) -> tuple[int, list[str]]:
    """Trace all operations, check their states, and return how many there were and what went wrong.

    Args:
        sample: number of states of each operation that are checked; None: all.
        home: an empty folder.
        say: receives one line for each operation.
    """
    import adaptfault as af

    tried = 0
    wrong = []

    def attempt(name: str, trace: Trace, call: Callable[[Tree, bool, Path], None]) -> None:
        nonlocal tried
        states = failed = 0
        for tree, complete in trace.states(sample=sample):
            states += 1
            with (
                tempfile.TemporaryDirectory(dir=home) as place,
                mock.patch.object(os, "fsync", return_value=None),
            ):
                try:
                    call(tree, complete, Path(place))
                except Exception as error:
                    failed += 1
                    wrong.append(f"{name}, state {states}: {type(error).__name__} {error}")
        tried += states
        say(f"{name}: {len(trace.steps)} steps, {states} states, {failed} wrong")

    with small_versions():
        (home / "robot").mkdir()
        keys = Keys.written(home)
        traced = list(operations(home / "robot", keys))
        x, expected = predictions(af.Bundle.open(home / "robot" / NAME))
        for one in traced:
            attempt(
                one.name, one.trace, lambda *state, one=one: check(one, *state, expected, x, keys)
            )
        (home / "log").mkdir()
        trace, frames = traced_recording(home / "log")
        attempt("recording", trace, lambda t, c, p: check_recording(t, c, p, frames))
    return tried, wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--all", action="store_true", help="every state, not a sample")
    args = parser.parse_args()
    logging.getLogger("adaptfault").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as home:
        tried, wrong = run(sample=None if args.all else 12, home=Path(home))
    print("\n".join(wrong[:20]))
    print(f"{tried} states after a power cut, {len(wrong)} wrong")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
