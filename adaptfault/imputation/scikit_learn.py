"""Imputation and fault tolerance for scikit-learn estimators. No torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import (
    BaseEstimator,
    ClassifierMixin,
    MetaEstimatorMixin,
    OneToOneFeatureMixin,
    RegressorMixin,
    TransformerMixin,
    clone,
)
from sklearn.model_selection import GroupKFold, KFold, StratifiedGroupKFold, StratifiedKFold
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted, validate_data

from adaptfault.imputation.cross_fitted import CrossFitted, by_missing
from diagnostics import FaultSet
from diagnostics.faults import Cells
from diagnostics.preprocessing.array_likes import plain_array


def _unmasked(given: Any) -> Any:
    """Return samples with what is masked as NaN, which scikit-learn would read; others as they
    are."""
    return plain_array(given) if isinstance(given, np.ma.MaskedArray) else given


class CellImputer(OneToOneFeatureMixin, TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Imputes NaN, and the cells of F, by the conditional mean given the other features.

    Equivalent to one step of ``sklearn.impute.IterativeImputer`` with a multivariate Gaussian
    (Ledoit-Wolf covariance), recalibrated so that it is no worse than the mean of the feature on
    held-out samples.

    Args:
        fault_set: F, imputed in each sample whatever it holds; cell indices, or a FaultSet over D
            cells. X may have a multiple of D columns, as
            ``[mean of each cell, maximum of each cell]``. None: NaN only.

    Attributes:
        mean_: ``[n_features]``, mean of each feature.
        n_features_in_, feature_names_in_: as in scikit-learn.
    """

    def __init__(self, fault_set: Cells | None = None) -> None:
        self.fault_set = fault_set

    def fit(self, X: ArrayLike, y: object = None) -> CellImputer:
        """Estimate from healthy samples ``[n, D]``, n at least 2; NaN counts as the mean of the
        feature."""
        x = validate_data(
            self,
            _unmasked(X),
            dtype=np.float64,
            ensure_all_finite="allow-nan",
            ensure_min_samples=2,
        )
        known = ~np.isnan(x)
        count = np.maximum(known.sum(axis=0), 1)
        mean = np.where(known, x, 0).sum(axis=0) / count
        x = np.where(known, x, mean)
        self.mean_ = mean
        spread = x.std(axis=0)
        self._scale = np.where(spread > 0, spread, 1.0)
        self._model = CrossFitted((x - mean) / self._scale, np.arange(len(x)) % 2 == 1)
        self._maps: dict[
            bytes, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
        ] = {}
        return self

    def transform(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return ``X [n, D]`` with NaN and the cells of F imputed."""
        check_is_fitted(self)
        faulty = columns_of(self.fault_set, self.n_features_in_)
        X = _unmasked(X)
        if faulty.any():  # whatever they hold, infinity included
            X = np.array(plain_array(X), dtype=np.float64)
            if X.ndim == 2 and X.shape[1] == len(faulty):
                X[:, faulty] = np.nan
        x = validate_data(
            self, X, dtype=np.float64, ensure_all_finite="allow-nan", reset=False, copy=True
        )
        for of, mask in by_missing(np.isnan(x)):
            weight, bias, _ = self._map(mask)
            healthy = ((x[of] - self.mean_) / self._scale)[:, ~mask]
            x[np.ix_(of, mask)] = (healthy @ weight.T + bias) * self._scale[mask] + self.mean_[mask]
        return np.asarray(x)

    def _map(
        self, mask: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        key = mask.tobytes()
        if key not in self._maps:
            if len(self._maps) >= 64:
                self._maps.clear()
            self._maps[key] = self._model.affine(FaultSet.of(mask, len(mask)))
        return self._maps[key]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags


def columns_of(fault_set: Cells | None, n_features: int) -> NDArray[np.bool_]:
    """Return bool ``[n_features]``, the columns that belong to the cells of F.

    Raises:
        ValueError: the number of features is no multiple of the number of cells, or an index is out
            of range.
    """
    if fault_set is None:
        return np.zeros(n_features, dtype=bool)
    if not isinstance(fault_set, FaultSet):
        fault_set = FaultSet.of(fault_set, n_features)
    if n_features % fault_set.n_cells:
        raise ValueError(
            f"F is over {fault_set.n_cells} cells, X has {n_features} columns: no multiple of it"
        )
    return np.tile(fault_set.mask, n_features // fault_set.n_cells)


def _estimator_has(name: str) -> Callable[[Any], bool]:
    return lambda self: hasattr(getattr(self, "estimator_", self.estimator), name)


class _FaultTolerant(MetaEstimatorMixin, BaseEstimator):  # type: ignore[misc]
    """An estimator with healthy data, which adapts to F by imputation or by a refit on the healthy
    cells."""

    def __init__(self, estimator: Any, *, cv: int = 3) -> None:
        self.estimator = estimator
        self.cv = cv

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Any:
        """Fit the estimator to healthy samples; they are kept for :meth:`set_faults`.

        Args:
            X: ``[n, D]``, or a multiple of D columns (:class:`CellImputer`); NaN is imputed.
            y: targets, ``[n]``.
            groups: ``[n]``, recording of each sample; samples of one recording stay together in
                validation.
        """
        x, targets = validate_data(
            self,
            _unmasked(X),
            y,
            dtype=np.float64,
            multi_output=True,
            ensure_all_finite="allow-nan",
            ensure_min_samples=2,
        )
        x = CellImputer().fit(x).transform(x)
        y = np.asarray(targets)
        self._x = x
        self._y = y
        self._groups = None if groups is None else np.asarray(groups)
        self._fitted = clone(self.estimator).fit(x, y)
        self._imputer = CellImputer().fit(x)
        self._folds: list[tuple[NDArray[np.intp], NDArray[np.intp], Any, CellImputer]] | None = None
        if hasattr(self._fitted, "classes_"):
            self.classes_ = self._fitted.classes_
        return self.set_faults(None)

    def set_faults(self, fault_set: Cells | None) -> Any:
        """Adapt to F from the healthy data; earlier F have no effect. Returns self.

        Cross-validation compares imputing F in front of the fitted estimator with a refit on the
        healthy columns. The better one is used (``choice_``), of equals the imputation;
        ``validation_scores_`` holds both scores.
        """
        check_is_fitted(self)
        mask = columns_of(fault_set, self.n_features_in_)
        if mask.all():
            raise ValueError(
                "F holds all cells: no healthy one is left to predict from; replace the sensor"
            )
        self.fault_set_ = fault_set
        self._mask = mask
        self.estimator_ = self._fitted
        self.choice_: Literal["none", "impute", "refit"] = "none"
        self.validation_scores_: dict[str, float] = {}
        if mask.any():
            self.validation_scores_ = self._validate(mask)
            self.choice_ = (
                "refit"
                if self.validation_scores_["refit"] > self.validation_scores_["impute"]
                else "impute"
            )
            if self.choice_ == "refit":
                self.estimator_ = clone(self.estimator).fit(self._x[:, ~mask], self._y)
        return self

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Return predictions ``[n]`` for samples ``[n, D]``; the columns of F may hold anything,
        NaN included."""
        x = self._input(X)
        return np.asarray(self.estimator_.predict(x))

    def _input(self, X: ArrayLike) -> NDArray[np.float64]:
        check_is_fitted(self)
        x = np.array(plain_array(X), dtype=np.float64)
        if x.ndim == 2 and x.shape[1] == self.n_features_in_:
            x[:, self._mask] = np.nan
        x = self._imputer.transform(x)
        return x[:, ~self._mask] if self.choice_ == "refit" else x

    def _validate(self, mask: NDArray[np.bool_]) -> dict[str, float]:
        """Return the mean validation score of both choices."""
        if self._folds is None:  # shared by all F
            self._folds = []
            for train, test in self._split():
                imputer = CellImputer().fit(self._x[train])
                self._folds.append(
                    (
                        train,
                        test,
                        clone(self.estimator).fit(self._x[train], self._y[train]),
                        imputer,
                    )
                )
        scores = np.zeros(2)
        for train, test, whole, imputer in self._folds:
            x = self._x[test].copy()
            x[:, mask] = np.nan
            refit = clone(self.estimator).fit(self._x[train][:, ~mask], self._y[train])
            scores += (
                whole.score(imputer.transform(x), self._y[test]),
                refit.score(x[:, ~mask], self._y[test]),
            )
        return dict(zip(("impute", "refit"), (scores / len(self._folds)).tolist(), strict=True))

    def _split(self) -> Any:
        classes = hasattr(self._fitted, "classes_")
        if self._groups is not None:
            split = StratifiedGroupKFold(self.cv) if classes else GroupKFold(self.cv)
            return split.split(self._x, self._y, self._groups)
        split = (StratifiedKFold if classes else KFold)(self.cv, shuffle=True, random_state=0)
        return split.split(self._x, self._y)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags


class FaultTolerantClassifier(ClassifierMixin, _FaultTolerant):  # type: ignore[misc]
    """A scikit-learn classifier that adapts to faulty cells.

    Args:
        estimator: the classifier; it is cloned.
        cv: folds of the validation in :meth:`set_faults`.

    Attributes:
        choice_: "none", "impute" or "refit".
        validation_scores_: accuracy of both choices for the present F.
        fault_set_: F.
        classes_: class labels.
    """

    @available_if(_estimator_has("predict_proba"))  # type: ignore[untyped-decorator, unused-ignore]
    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return class probabilities ``[n, n_classes]``."""
        x = self._input(X)
        return np.asarray(self.estimator_.predict_proba(x))

    @available_if(_estimator_has("decision_function"))  # type: ignore[untyped-decorator, unused-ignore]
    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Return the decision function ``[n]`` or ``[n, n_classes]``."""
        x = self._input(X)
        return np.asarray(self.estimator_.decision_function(x))


class FaultTolerantRegressor(RegressorMixin, _FaultTolerant):  # type: ignore[misc]
    """A scikit-learn regressor that adapts to faulty cells.

    Args:
        estimator: the regressor; it is cloned.
        cv: folds of the validation in :meth:`set_faults`.

    Attributes:
        choice_: "none", "impute" or "refit".
        validation_scores_: R2 of both choices for the present F.
        fault_set_: F.
    """

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags
