"""Recordings that several test modules use: simulated grasps, and real ones where they are at hand."""

from __future__ import annotations

import ast
import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.grasps import simulate
from adaptfault.recordings import Recordings, load, save_npz
from adaptfault.robot.bundle import Bundle
from diagnostics import Fault, Line, SelfDiagnosis, SensorLayout, line_fault


def without_torch(path: Path) -> bool:
    """Say whether a test module can be imported here."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in getattr(node, "names", [])]
        if isinstance(node, ast.Import | ast.ImportFrom):
            try:
                for name in names:
                    importlib.import_module(name)
            except ModuleNotFoundError as error:
                if error.name == "torch":
                    return False
    return True


if importlib.util.find_spec("torch") is None:  # what does without it is tested without it: make test-pythons
    collect_ignore = [p.name for p in Path(__file__).parent.glob("test_*.py") if not without_torch(p)]

REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "sdh2x13x6_grasps36.npz"


@pytest.fixture(scope="session")
def grasps() -> Recordings:
    """140 simulated grasps of the paper's task, 20 a class."""
    return simulate(20, seed=3)


@pytest.fixture(scope="session")
def fitted(grasps: Recordings) -> SelfDiagnosis:
    """Fitted on every other of the simulated grasps."""
    return SelfDiagnosis(grasps.layout).fit(grasps.frames[::2])


@pytest.fixture(scope="session")
def real_grasps() -> Recordings:
    """856 grasps of a real hand; a test that needs them is skipped where they are absent."""
    if not REAL.exists():
        pytest.skip("the real recordings are not here")
    return load(REAL).recordings


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


SMALL = SensorLayout(2, 6, 5)
SMALL_CLASSES = ("nothing", "softer", "harder")


@pytest.fixture(scope="session")
def small_grasps() -> Recordings:
    """90 simulated grasps of a small array, 30 a class."""
    return simulate(30, SMALL, n_frames=60, seed=1, classes=SMALL_CLASSES)


@pytest.fixture(scope="session")
def made_bundle(small_grasps: Recordings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle made by the command line; not to be changed."""
    pytest.importorskip("torch")
    home = tmp_path_factory.mktemp("bundle")
    save_npz(home / "grasps.npz", small_grasps)
    out = home / "robot.bundle"
    assert main(["train", str(home / "grasps.npz"), "--out", str(out), "--epochs", "8", "--quiet"]) == 0
    return out


@pytest.fixture
def bundle(made_bundle: Path, tmp_path: Path) -> Bundle:
    """A copy of it, to be changed."""
    shutil.copytree(made_bundle, tmp_path / "robot.bundle")
    return Bundle.open(tmp_path / "robot.bundle")


@pytest.fixture(scope="session")
def later_grasps() -> list[np.ndarray]:
    """24 grasps of the same small sensor, healthy, on a later day."""
    grasps = simulate(12, SMALL, n_frames=60, seed=99, classes=SMALL_CLASSES)
    return [frames for frames, label in zip(grasps.frames, grasps.labels, strict=True) if label > 0]


@pytest.fixture(scope="session")
def broken_row() -> Fault:
    return line_fault(SMALL, Line(1, "row", 2), "short")
