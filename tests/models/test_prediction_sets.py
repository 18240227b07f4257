"""Sets of classes that hold the true one."""

import numpy as np
import pytest

from adaptfault.models.prediction_sets import PredictionSets


def drawn(rng: np.random.Generator, recordings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Probabilities of 4 classes, the true ones, and the recordings of windows that agree within a
    recording."""
    counts = rng.integers(1, 9, recordings)
    recording = np.repeat(np.arange(recordings), counts)
    y = rng.integers(0, 4, recordings)[recording]
    quality = rng.normal(1.5, 1.5, recordings)[recording]
    logits = rng.normal(0, 1, (len(y), 4)) + quality[:, None] * np.eye(4)[y]
    likely = np.exp(logits)
    return likely / likely.sum(axis=1, keepdims=True), y, recording


@pytest.mark.parametrize("recordings", [9, 30, 200])
def test_sets_of_new_recordings_hold_the_true_class_as_often_as_stated(recordings):
    rng = np.random.default_rng(recordings)
    held = []
    for _ in range(400):
        sets = PredictionSets.fit(*drawn(rng, recordings))
        likely, y, _ = drawn(rng, 1)
        held.append(sets.sets(likely, 0.1)[np.arange(len(y)), y].mean())
    error = np.std(held) / np.sqrt(len(held))
    assert np.mean(held) > 0.9 - 3 * error
    # no looser than one recording makes it
    assert np.mean(held) < 0.9 + 1 / (recordings + 1) + 3 * error


def test_with_one_window_a_recording_the_threshold_is_that_of_split_conformal_prediction():
    rng = np.random.default_rng(0)
    scores = rng.random(99)
    likely = np.stack([1 - scores, scores], axis=1)
    sets = PredictionSets.fit(likely, np.zeros(99, np.int64), np.arange(99))
    for alpha in (0.05, 0.1, 0.5):
        rank = int(np.ceil((99 + 1) * (1 - alpha) - 1e-9))
        assert sets.threshold(alpha) == pytest.approx(np.sort(scores)[rank - 1])


class Given:
    """A classifier for MAPIE whose inputs are its probabilities."""

    def __init__(self, n_classes: int) -> None:
        self.classes_ = np.arange(n_classes)
        self.n_features_in_ = n_classes

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def fit(self, x: np.ndarray, y: np.ndarray) -> "Given":
        return self

    def predict_proba(self, x: np.ndarray) -> np.ndarray:
        return x

    def predict(self, x: np.ndarray) -> np.ndarray:
        return x.argmax(axis=1)


@pytest.mark.parametrize("recordings", [25, 60, 300])
def test_with_one_window_a_recording_the_sets_are_those_of_mapie(recordings):
    mapie = pytest.importorskip("mapie.classification", reason="pip install mapie")
    rng = np.random.default_rng(recordings)
    y = rng.integers(0, 4, recordings)
    likely = rng.dirichlet(np.ones(4), recordings) + np.eye(4)[y] * rng.random((recordings, 1))
    likely /= likely.sum(axis=1, keepdims=True)
    new = rng.dirichlet(np.ones(4), 500)
    ours = PredictionSets.fit(likely, y, np.arange(recordings))
    for alpha in (0.05, 0.1, 0.3):
        theirs = mapie.SplitConformalClassifier(Given(4), 1 - alpha, conformity_score="lac")
        _, sets = theirs.conformalize(likely, y).predict_set(new)
        assert np.array_equal(ours.sets(new, alpha), sets[:, :, 0])


def test_too_few_recordings_give_sets_of_all_classes():
    sets = PredictionSets.fit(*drawn(np.random.default_rng(1), 8))
    assert sets.threshold(0.1) == np.inf
    assert sets.sets(np.array([[1.0, 0.0, 0.0, 0.0]]), 0.1).all()


def unequal(rng: np.random.Generator, recordings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same where class 0 is harder to tell than the others."""
    likely, y, recording = drawn(rng, recordings)
    likely[y == 0, 0] *= 0.2
    return likely / likely.sum(axis=1, keepdims=True), y, recording


def test_sets_by_class_hold_each_class_as_often_as_stated():
    rng = np.random.default_rng(3)
    held = {False: [], True: []}
    for _ in range(200):
        fitted = PredictionSets.fit(*unequal(rng, 120))
        likely, y, recording = unequal(rng, 60)
        first = [np.flatnonzero(recording == one)[0] for one in range(60)]
        for by_class in held:
            inside = fitted.sets(likely, 0.1, by_class)[np.arange(len(y)), y][first]
            held[by_class].append([inside[y[first] == label].mean() for label in range(4)])
    error = np.std(held[True], axis=0) / np.sqrt(200)
    assert (np.mean(held[True], axis=0) > 0.9 - 3 * error).all()
    assert (np.mean(held[True], axis=0) < 0.97).all()
    assert np.mean(held[False], axis=0)[0] < 0.8


def test_a_class_with_too_few_recordings_is_in_every_set_by_class():
    likely, y, recording = drawn(np.random.default_rng(4), 80)
    kept = ~np.isin(recording, np.unique(recording[y == 2])[8:])
    sets = PredictionSets.fit(likely[kept], y[kept], recording[kept]).sets(likely, 0.1, True)
    assert sets[:, 2].all()
    assert not sets.all(axis=0)[[0, 1, 3]].any()


def test_what_is_stored_tells_the_sets_by_class_and_their_mean_size():
    likely, y, recording = drawn(np.random.default_rng(5), 100)
    fitted = PredictionSets.fit(likely, y, recording)
    assert fitted.size == fitted.sets(likely, 0.1).sum(axis=1).mean()
    stored = PredictionSets.from_dict(fitted.to_dict())
    assert stored.size == fitted.size
    assert (stored.sets(likely, 0.1, True) >= fitted.sets(likely, 0.1, True)).all()
    without = fitted.to_dict()
    del without["by_class"]
    with pytest.raises(ValueError, match="need validation by class"):
        PredictionSets.from_dict(without).sets(likely, 0.1, True)


@pytest.mark.parametrize("alpha", [0.0, 1.0, -1, np.nan])
def test_an_alpha_that_is_no_share_is_refused(alpha):
    with pytest.raises(ValueError, match="alpha is the share of wrong sets"):
        PredictionSets.fit(*drawn(np.random.default_rng(1), 8)).threshold(alpha)


def test_what_is_stored_makes_no_set_smaller_and_hardly_any_larger():
    sets = PredictionSets.fit(*drawn(np.random.default_rng(2), 900))
    stored = PredictionSets.from_dict(sets.to_dict())
    assert len(stored.scores) <= 1001
    for alpha in np.linspace(0.01, 0.9, 50):
        exact = sets.threshold(alpha)
        assert exact <= stored.threshold(alpha) <= sets.threshold(alpha - 0.002)


@pytest.mark.parametrize(
    "damaged",
    [
        {"scores": [0.1], "weights": [0.1, 0.2]},
        {"scores": [0.2, 0.1], "weights": [0.1, 0.2]},
        {"scores": [0.1, 0.2], "weights": [0.1, -0.2]},
    ],
)
def test_damaged_scores_are_refused(damaged):
    with pytest.raises(ValueError, match="scores of the sets of classes"):
        PredictionSets.from_dict(damaged)
