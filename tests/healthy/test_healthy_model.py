import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.healthy.model import HealthyModel, contact_events, p_floor_of
from diagnostics.healthy.prediction import Prediction
from diagnostics.healthy.tiled_model import ReferenceEvents, fit_healthy_model
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.scale import Scale

LAYOUT = SensorLayout(1, 1, 12)
SCALE = Scale(np.zeros(12), 0.05, 5.0)


def blobs(seed: int, recordings: int = 150) -> list[np.ndarray]:
    """Presses on a line of 12 cells; what they do not reach reads exactly 0; cell 11 is never
    reached."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(recordings):
        centre = rng.uniform(1, 7.5)
        force = rng.uniform(0.8, 2) * np.sin(np.linspace(0, np.pi, 40))[:, None]
        load = force * (
            1 - ((np.arange(12) - centre - np.linspace(0, 0.3, 40)[:, None]) / 2.5) ** 2
        )
        found.append(np.where(load > 0.1, load, 0))
    return found


def whole_events(recordings: list[np.ndarray], scale: Scale = SCALE) -> np.ndarray:
    """Return the features of the contact events in recordings, ``[n, 4, D]``."""
    return np.stack([e.whole.features() for r in recordings for e in contact_events(r, scale)])


@pytest.fixture(scope="module")
def model() -> HealthyModel:
    return fit_healthy_model(blobs(0), LAYOUT, SCALE)


@pytest.fixture(scope="module")
def unseen() -> np.ndarray:
    """Features of presses that the model was not fitted on."""
    return whole_events(blobs(1, 100))


ALL = np.ones(12, bool)


def all_but(*cells: int) -> np.ndarray:
    return ~np.isin(np.arange(12), cells)


def test_a_cell_between_loaded_ones_is_hardly_ever_unloaded_and_one_far_from_them_nearly_always(
    model, unseen
):
    never = model.predict(unseen, ALL).never
    loaded = unseen[:, 2] > 0
    assert np.median(never[:, 4][loaded[:, 3] & loaded[:, 5]]) < 0.05
    assert never[:, 10][~loaded[:, 8:].any(axis=1)].min() > 0.9


def test_it_predicts_new_events_better_than_the_share_of_each_cell(model, unseen):
    cells = np.arange(1, 9)
    unloaded = unseen[:, 2, cells] == 0
    seen = whole_events(blobs(0))

    def log_loss(p: np.ndarray) -> float:
        return float(-np.log(np.where(unloaded, p, 1 - p)).mean())

    own_share = np.broadcast_to((seen[:, 2, cells] == 0).mean(axis=0), unloaded.shape)
    assert log_loss(model.predict(unseen, ALL).never[:, cells]) < 0.5 * log_loss(own_share)


@pytest.mark.parametrize("predictors", [ALL, all_but(4)])
def test_the_reading_of_a_cell_does_not_change_its_own_prediction(model, unseen, predictors):
    spoiled = unseen.copy()
    spoiled[:, :, 4] = 1.0
    for name in ("never", "always", "mean"):
        predicted, from_spoiled = (
            getattr(model.predict(f, predictors), name)[:, 4] for f in (unseen, spoiled)
        )
        np.testing.assert_allclose(from_spoiled, predicted, atol=1e-5, err_msg=name)


def test_the_reading_of_a_cell_that_is_no_predictor_changes_no_prediction(model, unseen):
    predictors = all_but(3, 6)
    spoiled = unseen.copy()
    spoiled[:, :, [3, 6]] = 0.7
    for name in ("never", "always", "mean"):
        predicted, from_spoiled = (
            getattr(model.predict(f, predictors), name) for f in (unseen, spoiled)
        )
        np.testing.assert_allclose(from_spoiled, predicted, atol=1e-5, err_msg=name)


def test_the_load_of_a_cell_is_predicted_from_the_others_even_beside_excluded_ones(model, unseen):
    truth = unseen[:, 1, 4]
    for predictors, share in ((ALL, 0.3), (all_but(4, 5), 0.5)):
        error = model.predict(unseen, predictors).mean[:, 4] - truth
        assert np.sqrt(np.mean(error**2)) < share * truth.std()


def test_without_predictors_the_prediction_is_the_average(model, unseen):
    expected = model.predict(unseen, ~ALL)
    assert np.ptp(expected.never, axis=0).max() < 1e-5
    assert expected.mean[0] == pytest.approx(model.predict(unseen, ~ALL).mean[-1])
    assert expected.never[0, 10] > expected.never[0, 4]


def test_a_cell_that_was_never_loaded_is_predicted_to_stay_unloaded(model, unseen):
    assert model.predict(unseen, ALL).never[:, 11].min() > 0.99


def test_cells_may_rest_at_any_value():
    offset = np.linspace(0, 2, 12)
    moved = whole_events([r + offset for r in blobs(0)], Scale(offset, 0.05, 5.0))
    plain = whole_events(blobs(0))
    np.testing.assert_allclose(moved, plain, atol=1e-3)


def test_a_wider_range_of_loads_is_likelier_and_a_cell_of_unknown_spread_reads_any_load_as_often():
    one = np.ones((1, 2))
    expected = Prediction(one, one, np.array([[0.5, 0.5]]), np.array([0.1, np.nan]))
    cells = np.arange(2)
    narrow = expected.within(np.array([0.45, 0.45]), np.array([0.55, 0.55]), cells)
    wide = expected.within(np.array([0.3, 0.3]), np.array([0.7, 0.7]), cells)
    far = expected.within(np.array([0.0, 0.0]), np.array([0.1, 0.1]), cells)
    assert 0 < far[0, 0] < narrow[0, 0] < wide[0, 0] < 1
    np.testing.assert_allclose([narrow[0, 1], wide[0, 1], far[0, 1]], [0.1, 0.4, 0.1])
    # at full scale
    assert expected.within(np.array([0.9, 0.9]), np.array([np.inf, np.inf]), cells)[0, 1] == 1


def test_large_arrays_are_modelled_in_tiles_that_cover_every_cell():
    layout = SensorLayout(1, 2, 208)
    rng = np.random.default_rng(0)
    column = np.arange(416) % 208
    recordings = []
    for _ in range(120):
        force = 2 * np.sin(np.linspace(0, np.pi, 8))[:, None]
        recordings.append(np.maximum(0, force * (1 - ((column - rng.uniform(0, 208)) / 12) ** 2)))
    scale = Scale(np.zeros(416), 0.05, 5.0)
    model = fit_healthy_model(recordings, layout, scale)
    assert len(model.local_regressions) > 1
    assert sorted(
        np.concatenate([regression.outputs for regression in model.local_regressions])
    ) == list(range(416))
    features = whole_events(recordings, scale)
    expected = model.predict(features, np.ones(416, bool))
    assert np.isfinite(expected.spread).all()
    loaded = features[:, 2] > 0
    assert expected.never[loaded].mean() < 0.3
    assert expected.never[~loaded].mean() > 0.9


def patted(recordings: int, times: int) -> list[np.ndarray]:
    """Return recordings of one press each, repeated several times."""
    return [
        np.tile(np.concatenate([np.zeros((8, 12)), press]), (times, 1))[8:-4]
        for press in blobs(3, recordings)
    ]


def test_repeated_presses_count_as_one_event():
    once, again = (
        ReferenceEvents.of(RecordingBlocks(patted(20, times)), LAYOUT, SCALE) for times in (1, 6)
    )
    assert once.number(0) == again.number(0) == 20
    features, source = again.drawn(0, 1000, np.random.default_rng(0))
    assert len(features) == len(source) > 6 * 20
    (regression,) = fit_healthy_model(patted(20, 6), LAYOUT, SCALE).local_regressions
    assert regression.p_floor == p_floor_of(20)


@pytest.mark.parametrize(("recordings", "sources"), [(20, 20), (3, 18)])
def test_a_recording_is_one_source_unless_there_are_few(recordings: int, sources: int):
    events = ReferenceEvents.of(RecordingBlocks(patted(recordings, 6)), LAYOUT, SCALE)
    _, source = events.drawn(0, 1000, np.random.default_rng(0))
    assert sorted(set(source.tolist())) == list(range(sources))
    assert events.number(0) == sources
