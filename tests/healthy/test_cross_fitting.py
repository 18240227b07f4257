"""Training samples of the stacking."""

import numpy as np

from diagnostics import SensorLayout
from diagnostics.healthy.cross_fitting import FOLDS, stacking_samples
from diagnostics.healthy.stacking import N_FEATURES

PRESENT = np.ones((1, 6, 7), bool)
PRESENT[0, 0, :2] = False
LAYOUT = SensorLayout(1, 6, 7, present=PRESENT)
OUTPUTS = np.array([9, 10, 16, 17, 24, 30])
EVENTS = 12
DRAWS = 3


class Spy:
    """Regressions that record the events they were fitted on, those they predicted, and the
    predictors."""

    outputs = OUTPUTS

    def __init__(self) -> None:
        self.trained_on: list[set[int]] = []
        self.scored: list[tuple[set[int], np.ndarray]] = []

    def fit(self, features: np.ndarray) -> object:
        self.trained_on.append(numbers(features))
        return self

    def predict(self, held: np.ndarray, predictors: np.ndarray) -> np.ndarray:
        assert not numbers(held) & self.trained_on[-1]
        self.scored.append((numbers(held), predictors))
        return np.zeros((4, len(held), len(OUTPUTS)))


def numbers(features: np.ndarray) -> set[int]:
    """Return the numbers of the events behind features."""
    return set(np.rint(features[:, 0, 20] * 100).astype(int).tolist())


def cross_fitted(spy: Spy) -> tuple[np.ndarray, np.ndarray]:
    event = np.arange(EVENTS * DRAWS) // DRAWS
    features = np.random.default_rng(0).random((len(event), 4, LAYOUT.n_cells)).astype(np.float32)
    features[:, 0, 20] = event / 100
    features[:, 2] = features[:, 2] > 0.5
    features[:, 3] = (features[:, 3] > 0.5) & (features[:, 2] > 0)
    return stacking_samples(
        features, event, LAYOUT, OUTPUTS, spy.fit, 1.0, np.random.default_rng(1)
    )


def test_each_event_is_predicted_by_regressions_fitted_on_the_other_folds():
    spy = Spy()
    cross_fitted(spy)
    assert len(spy.trained_on) == FOLDS
    assert all(len(trained_on) == EVENTS - EVENTS // FOLDS for trained_on in spy.trained_on)
    assert set().union(*(held for held, _ in spy.scored)) == set(range(EVENTS))


def test_few_to_nearly_all_cells_are_left_out_of_the_predictors():
    spy = Spy()
    cross_fitted(spy)
    shares = [1 - predictors[PRESENT.ravel()].mean() for _, predictors in spy.scored]
    assert min(shares) < 0.05 < 0.9 < max(shares)
    everywhere = np.logical_or.reduce([~predictors for _, predictors in spy.scored])
    assert (everywhere == PRESENT.ravel()).all()


def test_each_sample_has_the_features_of_a_cell_and_whether_it_was_never_or_always_loaded():
    samples, did = cross_fitted(Spy())
    assert samples.shape == (len(did), N_FEATURES)
    never, always = did.sum(axis=0)
    assert 0 < always < len(did) - never < len(did)
