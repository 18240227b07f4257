"""A forest as tensors."""

import json

import numpy as np
import pytest
import torch
from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor

from adaptfault.models import forest as forests
from adaptfault.models.forest import Forest, fit_forest

FOLDS = np.arange(60) % 5


@pytest.fixture(scope="module", autouse=True)
def few_trees():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(forests, "TREES", 8)
        yield


def inputs(n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Columns that are constant, in few steps, or anything; three classes of the first two."""
    rng = np.random.default_rng(0)
    x = rng.random((n, 6))
    x[:, 1] = np.round(4 * x[:, 1]) / 4
    x[:, 2] = 0.25
    return x, (x[:, 0] + x[:, 1] > 1).astype(int) + (x[:, 0] > 0.8)


def one_hot(y: np.ndarray, n: int = 3) -> np.ndarray:
    return np.eye(n, dtype=np.float32)[y]


@pytest.mark.parametrize("values", [False, True])
def test_a_group_of_trees_says_what_scikit_learns_say(values):
    x, y = inputs()
    targets = x[:, :2].astype(np.float32) if values else one_hot(y)
    group = forests._grown(x.astype(np.float32), targets, 3, values)
    kind = ExtraTreesRegressor if values else ExtraTreesClassifier
    share = 1 / 3 if values else "sqrt"
    peer = kind(8, max_depth=16, max_features=share, random_state=3)
    peer.fit(x.astype(np.float32), targets if values else y)
    others = np.random.default_rng(1).random((500, 6))
    expected = peer.predict(others) if values else peer.predict_proba(others)
    np.testing.assert_allclose(group(torch.from_numpy(others)), expected, atol=1e-6)


def test_a_held_out_window_is_judged_by_trees_that_were_fitted_without_it():
    x, y = inputs()
    whole = one_hot(y)
    _, found = fit_forest(x, whole, FOLDS)
    other = whole.copy()
    of_fold = 140 + np.flatnonzero(FOLDS == 2)
    other[of_fold] = np.roll(whole[of_fold], 1, axis=1)
    _, after = fit_forest(x, other, FOLDS)
    torch.testing.assert_close(after[FOLDS == 2], found[FOLDS == 2])
    assert not torch.equal(after[FOLDS != 2], found[FOLDS != 2])
    assert (found.argmax(1).numpy() == y[140:]).mean() > 0.8


def test_a_class_without_a_window_has_probability_0():
    x, y = inputs()
    forest, found = fit_forest(x, one_hot(y, 5), FOLDS)
    assert not forest(torch.from_numpy(x))[:, 3:].any()
    assert not found[:, 3:].any()


def test_a_forest_comes_back_from_its_state():
    x, y = inputs()
    forest, _ = fit_forest(x, one_hot(y), FOLDS)
    again = Forest.empty(json.loads(json.dumps(forest.about)), 3)
    again.load_state_dict(forest.state_dict())
    assert torch.equal(again(torch.from_numpy(x)), forest(torch.from_numpy(x)))


def test_inputs_in_another_order_give_the_same():
    x, y = inputs()
    forest, _ = fit_forest(x, one_hot(y), FOLDS)
    places = np.array([9, 4, 0, 2, 7, 1])
    wide = np.zeros((len(x), 10))
    wide[:, places] = x
    found = forest.reading(places)(torch.from_numpy(wide))
    assert torch.equal(found, forest(torch.from_numpy(x)))


def test_inputs_that_are_all_the_same_do_not_break_it():
    forest, found = fit_forest(np.zeros((80, 2)), one_hot(np.arange(80) % 3), FOLDS)
    assert torch.isfinite(forest(torch.zeros(1, 2, dtype=torch.double))).all()
    assert torch.isfinite(found).all()
