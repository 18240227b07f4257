from dataclasses import replace

import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.evidence.pad_level import PadLevel, PadLimit
from diagnostics.evidence.reference import Reference
from diagnostics.evidence.spatial import Exclusion
from diagnostics.evidence.stream_state import StreamState
from diagnostics.preprocessing.baseline import baseline

LAYOUT = SensorLayout(2, 4, 5, full_scale=1.0)
CELLS = 40
PAD = 20
TOLERANCE = 0.005


def recording(rng: np.random.Generator, rest: tuple[float, float]) -> np.ndarray:
    """Presses that come and go on half of the cells of pads that rest at ``rest`` for a whole
    recording."""
    time = np.arange(128)[:, None]
    force = np.maximum(0, np.sin(time / rng.uniform(6, 12)))
    pressed = rng.random(CELLS) < 0.5
    load = force * pressed * rng.uniform(0, 0.4, CELLS) + rng.normal(0, 0.002, (128, CELLS))
    return np.clip(load + np.repeat(rest, PAD), 0, 1)


def rests(rng: np.random.Generator) -> tuple[float, float]:
    """Return where the pads of a sensor with a wandering supply rest."""
    return float(rng.uniform(0.2, 0.3)), float(rng.uniform(0.03, 0.1))


@pytest.fixture(scope="module")
def recordings() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [recording(rng, (0.25, 0.0)), *(recording(rng, rests(rng)) for _ in range(29))]


@pytest.fixture(scope="module")
def reference(recordings) -> Reference:
    return Reference.fit(recordings, LAYOUT)


def temporal(log: np.ndarray, reference: Reference) -> np.ndarray:
    stream = StreamState(LAYOUT, reference, Exclusion())
    stream.extend(log)
    return stream.complete().temporal()


def opened(rest: tuple[float, float], cells: list[int]) -> np.ndarray:
    """Return a log without contact in which some cells read 0."""
    rng = np.random.default_rng(1)
    log = np.clip(np.repeat(rest, PAD) + rng.normal(0, 0.002, (160, CELLS)), 0, 1)
    log[48:, cells] = 0.0
    return log


def test_an_open_cell_is_found_untouched_also_where_its_pad_has_rested_at_0(reference):
    found = temporal(opened((0.25, 0.06), [3, 27]), reference)
    assert np.flatnonzero(found >= 12).tolist() == [3, 27]


def test_where_a_pad_rests_at_0_now_no_cell_of_it_reads_too_little(reference):
    found = temporal(opened((0.25, 0.0), [3, 27]), reference)
    assert np.flatnonzero(found[PAD:] >= 12).tolist() == []


def test_a_pad_that_falls_to_0_between_recordings_has_no_open_cells(reference):
    log = np.concatenate([opened((0.25, 0.08), []), opened((0.25, 0.0), [])])
    assert np.flatnonzero(temporal(log, reference) >= 12).tolist() == []


def test_healthy_cells_of_other_recordings_read_enough(reference):
    rng = np.random.default_rng(2)
    for _ in range(10):
        log = np.concatenate([recording(rng, rests(rng)) for _ in range(3)])
        assert np.flatnonzero(temporal(log, reference) >= 12).tolist() == []


def test_a_pad_that_rests_at_0_and_a_short_reference_have_no_limit(recordings):
    def least_of(some: list[np.ndarray]) -> np.ndarray:
        rest = baseline(some, np.ones(CELLS, bool), TOLERANCE, 1.0)
        return PadLimit.fit(some, rest, LAYOUT, TOLERANCE).least

    at_0 = [np.where(np.arange(CELLS) < PAD, frames, 0.0) for frames in recordings]
    least = least_of(at_0)
    assert np.isfinite(least[:PAD]).all()
    assert np.isinf(least[PAD:]).all()
    assert np.isinf(least_of(recordings[:4])).all()


def test_the_level_of_a_pad_counts_while_a_run_lasts_and_is_that_of_its_unloaded_cells():
    frames = np.full((32, CELLS), 0.2)
    frames[:, :8] = 0.9
    frames[:, 8:10] = 0.0
    frames[:, 30:] = np.nan
    baseline_of_cells = np.full(CELLS, 0.3)

    def runs_since(start: int) -> ConstantRuns:
        return replace(ConstantRuns.begin(CELLS), start=np.where(np.arange(CELLS) == 5, start, 0))

    first = PadLevel.begin(CELLS).extend(frames, runs_since(3), 0, baseline_of_cells, LAYOUT)
    later = first.extend(frames - 0.1, runs_since(3), 32, baseline_of_cells, LAYOUT)
    others = np.arange(CELLS) != 5
    np.testing.assert_allclose(first.level[others], -0.1)
    assert first.level[5] == -np.inf
    np.testing.assert_allclose(later.level[others], -0.1)
    np.testing.assert_allclose(later.level[5], -0.2)
    anew = later.extend(frames - 0.2, runs_since(64), 64, baseline_of_cells, LAYOUT)
    np.testing.assert_allclose(anew.level[5], -0.3)
