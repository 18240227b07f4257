"""What a rim is taught by."""

import numpy as np

from diagnostics import SensorLayout
from diagnostics.healthy.cross_fitting import FOLDS, CrossFitting
from diagnostics.healthy.stacking import N_FEATURES, RegressionOutput

PRESENT = np.ones((1, 6, 7), bool)
PRESENT[0, 0, :2] = False
LAYOUT = SensorLayout(1, 6, 7, present=PRESENT)
OUTPUTS = np.array([9, 10, 16, 17, 24, 30])
TOUCHES, DRAWS = 12, 3


class Spy:
    """Regressions that write down what they were fitted on, what they were asked, and of which cells."""

    def __init__(self) -> None:
        self.taught: list[set[int]] = []
        self.scored: list[tuple[set[int], np.ndarray]] = []

    def fit(self, features: np.ndarray) -> object:
        fold = len(self.taught)
        self.taught.append(numbers(features))

        def regressed(held: np.ndarray, predictors: np.ndarray) -> RegressionOutput:
            assert not numbers(held) & self.taught[fold]
            self.scored.append((numbers(held), predictors))
            return RegressionOutput(*np.zeros((4, len(held), LAYOUT.n_cells)))

        return regressed


def numbers(features: np.ndarray) -> set[int]:
    """The touches that features are of: each bears its number."""
    return set(np.rint(features[:, 0, 20] * 100).astype(int).tolist())


def cross_fits(spy: Spy) -> CrossFitting:
    event = np.arange(TOUCHES * DRAWS) // DRAWS
    features = np.random.default_rng(0).random((len(event), 4, LAYOUT.n_cells)).astype(np.float32)
    features[:, 0, 20] = event / 100
    features[:, 2] = features[:, 2] > 0.5
    features[:, 3] = (features[:, 3] > 0.5) & (features[:, 2] > 0)
    return CrossFitting.of(features, event, TOUCHES, LAYOUT, OUTPUTS, spy.fit, 1.0, np.random.default_rng(1))


def test_each_touch_is_foreseen_by_regressions_that_were_taught_by_the_other_folds():
    spy = Spy()
    cross_fits(spy)
    assert len(spy.taught) == FOLDS
    assert all(len(taught) == TOUCHES - TOUCHES // FOLDS for taught in spy.taught)
    assert set().union(*(held for held, _ in spy.scored)) == set(range(TOUCHES))


def test_cells_are_left_out_few_and_many_of_all_there_are():
    spy = Spy()
    cross_fits(spy)
    shares = [1 - predictors[PRESENT.ravel()].mean() for _, predictors in spy.scored]
    assert min(shares) < 0.05 < 0.9 < max(shares)
    everywhere = np.logical_or.reduce([~predictors for _, predictors in spy.scored])
    assert (everywhere == PRESENT.ravel()).all()


def test_those_of_several_arrays_are_learned_from_together():
    one = cross_fits(Spy())
    both = CrossFitting.joined([one, one])
    assert one.samples.shape == (len(one.never), N_FEATURES) == (len(one.always), N_FEATURES)
    assert 0 < one.always.sum() < len(one.never) - one.never.sum() < len(one.never)
    np.testing.assert_array_equal(both.never, np.concatenate([one.never, one.never]))
    assert both.fit_stacking().weight.shape == (N_FEATURES, 2)
