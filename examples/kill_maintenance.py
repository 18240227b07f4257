"""Kills maintenance with kill -9 at random moments, again and again: kill_maintenance.py [--kills
N]

A bundle is made, a row breaks, and `adaptfault maintain` is killed N times, each time on a copy of
the bundle as the last kill left it, while new recordings come in. After each kill the bundle has to
open, its version has to predict, whatever was confirmed has to be there, and nothing may be damaged
but the seal of the journal. At the end maintenance runs to its end. Prints how far the kills let it
come.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

import adaptfault as af
from diagnostics import FaultKind, Line, SelfDiagnosis, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(2, 6, 5)
CLASSES = ("nothing", "softer", "harder")


def make(folder: Path) -> af.Bundle:
    grasps = af.simulate(20, LAYOUT, n_frames=60, seed=1, classes=CLASSES)
    windows = af.make_windows(grasps.frames, grasps.labels, LAYOUT)
    training, validation, test = af.split(windows)
    model = af.TactileTransformer(LAYOUT, len(CLASSES))
    af.train(model, training, validation, epochs=6, progress=False)
    diagnoser = SelfDiagnosis(LAYOUT).fit(grasps.frames)
    adapter = af.Adapter(model, training, validation)
    return af.Bundle.create(
        folder / "robot.bundle", model, adapter, diagnoser, check=test, class_names=CLASSES
    )


def log(folder: Path, number: int, kind: FaultKind) -> Path:
    """Write new recordings of a sensor whose row fails in one way or the other."""
    grasps = af.simulate(6, LAYOUT, n_frames=60, seed=100 + number, classes=CLASSES[1:])
    fault = line_fault(LAYOUT, Line(number % 2, "row", number % 6), kind)
    path = folder / f"log{number}.npz"
    af.save_npz(
        path, af.Recordings(tuple(inject(r, [fault], LAYOUT) for r in grasps.frames), LAYOUT)
    )
    return path


def maintain(bundle: af.Bundle, recordings: Path) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "adaptfault",
        "maintain",
        str(bundle.path),
        str(recordings),
        "--quiet",
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def check(bundle: af.Bundle, confirmed: int) -> str:
    """Return what state a kill left the bundle in; raises if it is not a good one."""
    again = af.Bundle.open(bundle.path)
    version = again.active()
    x = again.parts.check_windows().x[:4]
    assert np.isfinite(af.Adaptation.load(version.folder).predict_proba(x)).all()
    assert version.number >= confirmed, f"version {confirmed} was confirmed, {version.number} runs"
    again.versions[confirmed]
    problems = [p for p in again.problems() if "is readable" not in p]
    assert not problems, problems
    return f"version {version.number - confirmed:+d}, {len(again.journal.runs())} runs"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=4)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    states = Counter()
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        bundle = make(folder)
        began = time.perf_counter()
        process = maintain(bundle, log(folder, 0, FaultKind.SHORT))
        told = process.communicate()[0].decode()
        whole = time.perf_counter() - began
        assert "deployed" in told, told
        bundle.confirm()
        confirmed = bundle.active().number
        for kill in range(1, args.kills + 1):
            process = maintain(bundle, log(folder, kill, FaultKind.SHORT))
            time.sleep(rng.uniform(0.1, 1.1) * whole)
            ended = process.poll() is not None
            if not ended:
                os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            states["ended before" if ended else check(bundle, confirmed)] += 1
            if ended or kill % 3 == 0:
                bundle.confirm()
                confirmed = bundle.active().number
        process = maintain(bundle, log(folder, args.kills + 1, FaultKind.SHORT))
        told = process.communicate()[0].decode()
        assert told.startswith("ADAPTFAULT"), told
        check(bundle, confirmed)
    print(
        f"{args.kills} kills within the {whole:.1f} s of a run: every time the bundle opened,"
        " predicted, and kept what"
    )
    print(f"was confirmed. States after a kill: {dict(states)}")


if __name__ == "__main__":
    main()
