"""What a converter does to readings is read off a log of other contacts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diagnostics import SensorLayout
from diagnostics.sensor.converter_change import find_converter_change
from diagnostics.sensor.disturbance import Disturbance

LAYOUT = SensorLayout(1, 3, 4, full_scale=4095.0)


def loads(seed: int) -> list[np.ndarray]:
    """Return recordings of contacts as counts, of cells that rest at 20 to 60."""
    rng = np.random.default_rng(seed)
    rest = np.linspace(20, 60, LAYOUT.n_cells)
    press = np.sin(np.linspace(0, np.pi, 40))[:, None]
    return [np.rint(rest + 2500 * rng.beta(0.6, 1.5, LAYOUT.n_cells) * press) for _ in range(40)]


def found(log: list[np.ndarray], *names: str, step: float = 0.0):
    disturbances = [Disturbance(name, step, "") for name in names]
    return find_converter_change(log, loads(1), LAYOUT, disturbances)


@settings(max_examples=25, deadline=None)
@given(step=st.floats(40, 400), rounding=st.sampled_from([0.0, 0.5]), phase=st.floats(0, 1))
def test_coarse_steps_of_any_size_are_done_to_the_reference(step, rounding, phase):
    def coarse(frames: np.ndarray) -> np.ndarray:
        return np.maximum(np.floor(frames / step - phase + rounding) + phase, 0) * step

    change = found([coarse(frames) for frames in loads(2)], "quantised", step=step)
    read = np.concatenate(change.of(loads(1)))
    truth = np.concatenate([coarse(frames) for frames in loads(1)])
    # other contacts: a level that the log never reached is missing
    assert (np.abs(read - truth) < 1e-6).mean() > 0.85


@pytest.mark.parametrize("gain", [2.0, 5.0, 10.0])
def test_an_amplifier_that_saturates_is_done_to_the_reference(gain):
    rest = np.linspace(20, 60, LAYOUT.n_cells)

    def amplified(frames: np.ndarray) -> np.ndarray:
        return np.minimum(rest + gain * (frames - rest), 3000.0)

    change = found([amplified(frames) for frames in loads(2)], "saturated")
    assert change.top == 3000
    assert change.gain == pytest.approx(gain, rel=0.35)
    read = np.concatenate(change.of(loads(1)))
    assert read.min() >= 0
    assert np.abs(read - np.concatenate([amplified(f) for f in loads(1)])).mean() < 250


def test_missing_readings_stay_missing():
    change = found([np.floor(f / 256) * 256 for f in loads(2)], "quantised", step=256.0)
    frames = loads(1)[0]
    frames[3, 2] = np.nan
    (read,) = change.of([frames])
    assert np.isnan(read[3, 2])
    assert np.isfinite(read).sum() == frames.size - 1


def test_without_such_a_disturbance_nothing_is_changed():
    assert found(loads(2)) is None
    assert found(loads(2), "noise") is None
