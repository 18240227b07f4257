"""Recordings that several test modules use: simulated grasps, and real ones where they are at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adaptfault.grasps import simulate
from adaptfault.recordings import Recordings, load
from diagnostics import SelfDiagnosis

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
