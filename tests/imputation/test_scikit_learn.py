import subprocess
import sys

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from sklearn.svm import SVC
from sklearn.utils.estimator_checks import estimator_checks_generator
from sklearn.utils.validation import check_is_fitted

from adaptfault.imputation.scikit_learn import (
    CellImputer,
    FaultTolerantClassifier,
    FaultTolerantRegressor,
)
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout

D = 24
F = FaultSet((1, 4, 5, 11, 20), D)


def with_checks(*estimators):
    """As scikit-learn's ``parametrize_with_checks``, which gives a generator in 1.7: pytest 9 warns
    of it."""
    checks = [
        each
        for estimator in estimators
        for each in estimator_checks_generator(estimator, mark="xfail")
    ]
    return pytest.mark.parametrize(("estimator", "check"), checks)


@with_checks(CellImputer())
def test_the_imputer_passes_the_checks_of_scikit_learn(estimator, check):
    check(estimator)


@with_checks(
    FaultTolerantClassifier(LogisticRegression(max_iter=1000), cv=2),
    FaultTolerantRegressor(Ridge(), cv=2),
)
def test_the_fault_tolerant_estimators_pass_the_checks_of_scikit_learn(estimator, check):
    check(estimator)


def contacts(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames of a press on a line of cells, and its place in thirds."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, D, n)
    x = rng.uniform(0.5, 1, (n, 1)) * np.exp(-(((np.arange(D) - place[:, None]) / 3) ** 2))
    return x + rng.normal(0, 0.01, x.shape), (place // (D / 3)).astype(int)


def test_nan_and_f_are_imputed_alike_and_close_to_the_truth():
    x, _ = contacts(400, 0)
    new, _ = contacts(200, 1)
    missing = new.copy()
    garbage = new.copy()
    missing[:, F.mask] = np.nan
    garbage[:, F.mask] = np.inf
    imputed = CellImputer().fit(x).transform(missing)
    np.testing.assert_array_equal(CellImputer(F).fit(x).transform(garbage), imputed)
    np.testing.assert_array_equal(imputed[:, F.healthy], new[:, F.healthy])
    assert np.mean((imputed - new)[:, F.mask] ** 2) < 0.1 * np.var(new[:, F.mask], axis=0).mean()


def test_f_over_d_cells_covers_each_block_of_d_columns():
    x = np.concatenate([contacts(300, 0)[0], contacts(300, 0)[0] ** 2], axis=1)
    broken = x.copy()
    broken[:, [1, D + 1]] = 7.0
    np.testing.assert_allclose(CellImputer(FaultSet((1,), D)).fit(x).transform(broken), x, atol=0.2)
    with pytest.raises(ValueError, match="F is over 23 cells, X has 48 columns"):
        CellImputer(FaultSet((1,), 23)).fit(x).transform(x)


@pytest.mark.parametrize("estimator", [SVC(), ExtraTreesClassifier(50, random_state=0)])
def test_a_classifier_is_repaired_and_its_dropped_cells_may_hold_anything(estimator):
    x, y = contacts(400, 0)
    new, truth = contacts(200, 1)
    broken = new.copy()
    broken[:, F.mask] = 5.0
    tolerant = FaultTolerantClassifier(estimator).fit(x, y)
    harmed = tolerant.score(broken, truth)
    assert tolerant.set_faults(F) is tolerant
    repaired = tolerant.predict(broken)
    assert (repaired == truth).mean() > max(0.85, harmed)
    assert tolerant.choice_ == max(("impute", "refit"), key=tolerant.validation_scores_.__getitem__)
    broken[:, F.mask] = np.nan
    np.testing.assert_array_equal(tolerant.predict(broken), repaired)
    assert tolerant.set_faults(None).choice_ == "none"
    np.testing.assert_array_equal(tolerant.predict(new), clone(estimator).fit(x, y).predict(new))


def test_where_cells_carry_independent_information_the_better_choice_is_taken():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 4))
    y = x[:, 0] + x[:, 1] + 3 * np.sin(3 * x[:, 2])
    tolerant = FaultTolerantRegressor(make_pipeline(StandardScaler(), Ridge())).fit(x, y)
    tolerant.set_faults([2])
    assert set(tolerant.validation_scores_) == {"impute", "refit"}
    assert tolerant.score(np.where(np.arange(4) == 2, 100.0, x), y) > 0.2


def test_recordings_stay_together_in_validation():
    x, y = contacts(60, 0)
    tolerant = FaultTolerantClassifier(LogisticRegression(), cv=2).fit(
        np.repeat(x, 5, axis=0), np.repeat(y, 5), groups=np.repeat(np.arange(60), 5)
    )
    tolerant.set_faults(F)
    assert sorted(cell for _, test, *_ in tolerant._folds for cell in test) == list(range(300))
    for train, test, *_ in tolerant._folds:
        assert not set(train // 5) & set(test // 5)


def test_without_a_healthy_cell_nothing_is_predicted():
    x, y = contacts(60, 0)
    with pytest.raises(ValueError, match="F holds all cells"):
        FaultTolerantClassifier(LogisticRegression()).fit(x, y).set_faults(range(D))


def presses(n: int, seed: int) -> np.ndarray:
    """A recording of n presses of ten frames."""
    frames = contacts(n, seed)[0][:, None] * np.sin(np.linspace(0, np.pi, 10))[:, None]
    return np.maximum(frames, 0).reshape(-1, D)


def test_the_diagnosis_clones_and_ends_a_pipeline():
    layout = SensorLayout(1, 4, 6, full_scale=1.0)
    diagnoser = SelfDiagnosis(layout, false_discovery_rate=0.01)
    assert diagnoser.get_params() == {
        "layout": layout,
        "false_discovery_rate": 0.01,
    }
    pipeline = make_pipeline(FunctionTransformer(lambda counts: counts / 255), diagnoser)
    assert pipeline.fit(255 * presses(60, 0))[-1] is diagnoser
    check_is_fitted(pipeline)
    broken = np.where(np.arange(D) == 9, 1.0, presses(30, 1))
    assert 9 in diagnoser.diagnose(pipeline[:-1].transform(255 * broken)).fault_set
    again = clone(pipeline)[-1]
    assert again.get_params() == diagnoser.get_params()
    assert again.reference_ is None
    with pytest.raises(NotFittedError):
        check_is_fitted(again)
    assert diagnoser.reference_ is not None


def test_new_parameters_of_a_diagnosis_discard_its_fit():
    diagnoser = SelfDiagnosis(SensorLayout(1, 4, 6, full_scale=1.0)).fit(presses(60, 0))
    smaller = SensorLayout(1, 2, 3)
    assert diagnoser.set_params(layout=smaller) is diagnoser
    assert (diagnoser.layout, diagnoser.reference_) == (smaller, None)
    diagnoser.diagnose(np.zeros((20, 6)))
    with pytest.raises(ValueError, match="no parameter 'rate': use layout or false_discovery_rate"):
        diagnoser.set_params(rate=0.1)


WITHOUT_TORCH = """
import sys
import numpy as np
from sklearn.linear_model import LogisticRegression
from adaptfault import CellImputer, FaultTolerantClassifier, Restorer
from diagnostics import FaultSet, SensorLayout
x = np.random.default_rng(0).uniform(0, 5, (60, 6))
classifier = FaultTolerantClassifier(LogisticRegression()).fit(x, np.arange(60) % 2).set_faults([1])
answers = [
    classifier.predict(x),
    CellImputer(FaultSet((1,), 6)).fit(x).transform(x),
    Restorer(SensorLayout(1, 2, 3)).fit(x).transform(x, FaultSet((1,), 6)),
]
sys.exit("torch" in sys.modules or not all(np.isfinite(answer).all() for answer in answers))
"""


def test_scikit_learn_estimators_and_the_restorer_need_no_torch():
    assert subprocess.run([sys.executable, "-c", WITHOUT_TORCH], check=False).returncode == 0
