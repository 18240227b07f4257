"""Arrays of one pad, [T, rows, cols] and [n, T, rows, cols], are taken wherever recordings are."""

import numpy as np
import pytest

from adaptfault import Recordings, Restorer, make_windows, summarise
from diagnostics import Fault, Monitor, SelfDiagnosis, SensorLayout, inject

LAYOUT = SensorLayout(1, 4, 5, full_scale=10.0, unit="V")


@pytest.fixture(scope="module")
def flat():
    """Ten recordings [T, D] of loads that move over the pad."""
    rng = np.random.default_rng(1)
    rows, cols = np.mgrid[:4, :5]
    centre = rng.uniform(0, 4, (10, 1, 2))
    force = 4 * np.sin(np.linspace(0, np.pi, 40)) ** 2
    path = centre + np.cumsum(rng.normal(0, 0.05, (10, 40, 2)), axis=1)
    distance = (rows.ravel() - path[..., :1]) ** 2 + (cols.ravel() - path[..., 1:]) ** 2
    return np.round(
        force[:, None] * np.exp(-distance / 3) + rng.normal(0, 0.01, (10, 40, 20)).clip(0), 2
    )


@pytest.fixture(params=[(4, 5), (1, 4, 5)])
def given(request, flat):
    return flat.reshape(10, 40, *request.param)


@pytest.fixture(scope="module")
def flat_fit(flat):
    return SelfDiagnosis(LAYOUT).fit(list(flat))


def test_a_diagnosis_is_the_same(flat_fit, given):
    broken = [inject(one, [Fault("short", (7,))], LAYOUT) for one in given]
    wanted = flat_fit.diagnose(broken).to_dict()
    diagnoser = SelfDiagnosis(LAYOUT).fit(given)
    assert diagnoser.diagnose(np.reshape(broken, given.shape)).to_dict() == wanted
    alone = diagnoser.diagnose(broken[0].reshape(given.shape[1:]))
    assert (alone.n_recordings, alone.n_frames) == (1, 40)
    monitor = Monitor(diagnoser, wait=True)
    for frame in given[0]:
        monitor.update(frame)
    assert monitor.diagnosis().n_frames == 40


def test_windows_summaries_and_stored_recordings_are_the_same(flat, given):
    labels = np.arange(10)
    np.testing.assert_array_equal(
        make_windows(given, labels, LAYOUT).x, make_windows(list(flat), labels, LAYOUT).x
    )
    assert len(make_windows(given[0], None, LAYOUT)) == 4
    assert summarise(given, LAYOUT).to_dict() == summarise(list(flat), LAYOUT).to_dict()
    np.testing.assert_array_equal(Recordings(tuple(given), LAYOUT).frames, flat.astype(np.float32))


def test_restored_frames_are_the_same(flat, given):
    wanted = Restorer(LAYOUT).fit(list(flat))
    restorer = Restorer(LAYOUT).fit(given)
    gaps = np.where(np.arange(20) == 7, np.nan, flat[0])
    np.testing.assert_array_equal(
        restorer.transform(gaps.reshape(given.shape[1:])), wanted.transform(gaps)
    )
    np.testing.assert_array_equal(
        restorer.update(gaps[9].reshape(given.shape[2:])), wanted.update(gaps[9])
    )
