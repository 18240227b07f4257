"""The healthy model of a large array: each tile is predicted as a small array of its own."""

import json

import numpy as np
import pytest
from safetensors.numpy import load, save

from adaptfault.data.simulated_grasps import simulate
from diagnostics import Fault, FaultKind, SelfDiagnosis, SensorLayout, inject
from diagnostics.events.tiles import Tile
from diagnostics.healthy.local_regression import LocalRegression
from diagnostics.healthy.model import HealthyModel
from diagnostics.healthy.tiled_model import fit_healthy_model
from diagnostics.preprocessing.scale import Scale

PRESENT = np.ones((1, 24, 20), bool)
PRESENT[0, :3, :3] = PRESENT[0, 10, 7] = False
SKIN = SensorLayout(1, 24, 20, present=PRESENT)
CLASSES = ("normal", "void", "harder")


def grasps(n: int, seed: int) -> list[np.ndarray]:
    """``3 n`` recordings of 40 frames."""
    return [
        np.asarray(r, float)
        for r in simulate(n, SKIN, n_frames=40, seed=seed, classes=CLASSES).frames
    ]


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(SKIN).fit(grasps(8, 0))


@pytest.fixture(scope="module")
def model(fitted: SelfDiagnosis) -> HealthyModel:
    return fitted.reference_.model


def random_events(tile: Tile) -> tuple[np.ndarray, np.ndarray]:
    """Return random features ``[n, 4, inputs]`` of events, and random predictors."""
    rng = np.random.default_rng(0)
    n = len(tile.inputs)
    features = rng.random((9, 4, n)).astype(np.float32)
    features[:, 2] = features[:, 2] > 0.4
    return features, rng.random(n) < 0.7


@pytest.mark.parametrize(
    "i", [0, 2, 4], ids=["a corner without cells", "a corner", "the middle, one cell absent"]
)
def test_a_tile_is_predicted_as_a_small_array_of_the_same_cells(
    fitted: SelfDiagnosis, model: HealthyModel, i: int
):
    regression = model.local_regressions[i]
    tile = Tile(regression.inputs, regression.outputs)
    positions = np.array([SKIN.position(c) for c in tile.inputs.tolist()])[:, 1:]
    (top, left), (bottom, right) = positions.min(axis=0), positions.max(axis=0)
    small = SensorLayout(
        1,
        bottom - top + 1,
        right - left + 1,
        present=PRESENT[:, top : bottom + 1, left : right + 1],
    )
    cells = np.array(
        [small.cell(0, row - top, column - left) for row, column in positions.tolist()]
    )
    arrays = {
        name: value for name, value in vars(regression).items() if name not in ("inputs", "outputs")
    }
    alone = HealthyModel(
        (LocalRegression(cells, cells[regression.place], **arrays),), small, model.stacking
    )

    features, predictors = random_events(tile)
    padded = np.full((9, 4, small.n_cells), 0.5, np.float32)
    scored = np.ones(small.n_cells, bool)
    padded[:, :, cells] = features
    scored[cells] = predictors
    expected = alone.predict(padded, scored)
    every = np.zeros((9, 4, SKIN.n_cells), np.float32)
    every[:, :, tile.inputs] = features
    known = np.zeros(SKIN.n_cells, bool)
    known[tile.inputs] = predictors
    predicted = model.predict(every, known)
    for name in ("never", "always", "mean"):
        expected_values = getattr(expected, name)[:, cells[regression.place]]
        np.testing.assert_allclose(
            getattr(predicted, name)[:, tile.outputs], expected_values, atol=1e-5, err_msg=name
        )
    without = HealthyModel(alone.local_regressions, small).predict(padded, scored)
    assert np.abs(without.never - expected.never).max() > 0.05  # the stacking matters


def test_a_diagnosis_is_stored_with_its_stacking_to_the_last_bit(fitted: SelfDiagnosis):
    log = inject(np.concatenate(grasps(1, 1)), [Fault(FaultKind.OPEN, (210,))], SKIN)
    before = fitted.diagnose(log)
    about, arrays = fitted.state()
    restored = SelfDiagnosis.from_state(json.loads(json.dumps(about)), load(save(arrays)))
    was = fitted.reference_.model.stacking
    stacking = restored.reference_.model.stacking
    assert all(np.array_equal(value, getattr(was, name)) for name, value in vars(stacking).items())
    assert restored.diagnose(log).to_dict() == before.to_dict()


def test_what_absent_cells_read_changes_nothing_and_they_are_never_faulty(fitted: SelfDiagnosis):
    log = np.concatenate(grasps(2, 2))
    spoiled = log.copy()
    spoiled[:, ~PRESENT.ravel()] = 5.0
    diagnosis = fitted.diagnose(spoiled)
    assert diagnosis.to_dict() == fitted.diagnose(log).to_dict()
    assert not diagnosis.probability[~PRESENT.ravel()].any()


def test_dead_cells_of_a_large_array_are_found_with_hardly_a_false_one(
    fitted: SelfDiagnosis,
):
    healthy = np.concatenate(grasps(3, 3))
    often = np.flatnonzero((healthy > 0.5).mean(axis=0) > 0.2)  # held in many of the grasps
    dead = np.random.default_rng(0).choice(often, 12, replace=False).tolist()
    faults = [
        Fault(FaultKind.OPEN if i % 2 else FaultKind.SHORT, (cell,)) for i, cell in enumerate(dead)
    ]
    found = set(fitted.diagnose(inject(healthy, faults, SKIN)).fault_set)
    assert len(found - set(dead)) <= 1  # a rough fit has loose limits
    assert len(found & set(dead)) >= 11
    assert len(fitted.diagnose(healthy).fault_set) <= 1


def test_tiles_with_hardly_any_event_give_no_stacking():
    scale = Scale(np.zeros(SKIN.n_cells), 0.05, 5.0)
    assert fit_healthy_model(grasps(1, 0)[:1], SKIN, scale).stacking is None
