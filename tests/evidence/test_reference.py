import numpy as np
import pytest

from diagnostics import SensorLayout, freeze_stream
from diagnostics.evidence.reference import Reference

LAYOUT = SensorLayout(1, 4, 4)
CELLS = 16


def healthy(seed: int, recordings: int = 12, step: float = 0.0) -> list[np.ndarray]:
    """Presses that come and go, harder on some cells; readings rounded to converter steps."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(recordings):
        force = np.maximum(0, np.sin(np.arange(100) / rng.uniform(6, 12)))[:, None]
        load = force * rng.uniform(0.5, 3, CELLS) + rng.normal(0, 0.005, (100, CELLS))
        load = np.maximum(0, load)
        found.append(np.round(load / step) * step if step else load)
    return found


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference.fit(healthy(0), LAYOUT)


def test_the_tolerance_grows_with_the_converters_step_up_to_a_bound():
    fine, coarse, coarser = (
        Reference.fit(healthy(0, step=step), LAYOUT).tolerance for step in (0.001, 0.03, 0.5)
    )
    assert fine < coarse <= coarser <= 0.02 * LAYOUT.full_scale
    assert coarse > 0.03
    assert fine == Reference.unknown(LAYOUT).tolerance


def test_the_baseline_is_that_of_the_reference():
    offset = np.linspace(0, 1, CELLS)
    reference = Reference.fit([r + offset for r in healthy(0)], LAYOUT)
    np.testing.assert_allclose(reference.scale.baseline, offset, atol=0.02)


def test_repeated_frames_of_the_reference_raise_the_patience_with_load_only_where_they_are_loaded(
    reference,
):
    idle = Reference.fit(
        [freeze_stream(np.append(r, np.zeros((80, CELLS)), axis=0), 100, 180) for r in healthy(0)],
        LAYOUT,
    )
    holds = Reference.fit([freeze_stream(r, 10, 80) for r in healthy(0)], LAYOUT)
    assert (idle.patience, idle.loaded_patience) == (158, reference.loaded_patience)
    assert holds.patience == holds.loaded_patience > 70
    assert reference.patience < 70


def test_lines_that_agree_when_healthy_need_more_coincidences_to_count(reference):
    agreeing = [r.copy() for r in healthy(0)]
    for r in agreeing:
        r[:, 4:8] = r[:, 0:4]
    assert Reference.fit(agreeing, LAYOUT).duplicates.most > reference.duplicates.most


def test_missing_readings_and_lost_frames_in_the_reference_do_no_harm():
    gappy = healthy(0)
    for r in gappy:
        r[::7, 3] = np.nan
        r[20:22] = np.nan
    reference = Reference.fit(gappy, LAYOUT)
    assert np.isfinite(reference.scale.baseline).all()
    assert np.isfinite(reference.tolerance)
    assert np.isfinite(reference.usual.noise).all()
