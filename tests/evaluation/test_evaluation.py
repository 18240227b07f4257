"""Scores are the paper's, whatever the model is."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn

from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import Scores, accuracy_interval, evaluate, prediction_interval

TRUE = [0, 0, 0, 1, 1, 2]
PREDICTED = [0, 0, 1, 1, 0, 0]


class Says:
    """Predicts what it was told, as a list."""

    def __init__(self, classes: list[int]) -> None:
        self.classes = classes

    def predict(self, x: np.ndarray) -> list[int]:
        assert x.shape == (len(self.classes), 1, 2)
        return self.classes


def windows(y: list[int]) -> Windows:
    return Windows(np.zeros((len(y), 1, 2)), np.array(y), np.arange(len(y)))


def test_the_scores_are_those_computed_by_hand():
    scores = evaluate(Says(PREDICTED), windows(TRUE))
    assert scores.n == 6
    assert scores.accuracy == pytest.approx(3 / 6)
    assert scores.precision == pytest.approx((2 / 4 + 1 / 2 + 0) / 3)
    assert scores.recall == pytest.approx((2 / 3 + 1 / 2 + 0) / 3)
    assert scores.f1 == pytest.approx((4 / 7 + 1 / 2 + 0) / 3)
    assert scores.confusion.tolist() == [[2, 1, 0], [1, 1, 0], [1, 0, 0]]


def test_the_confusion_has_a_row_for_every_class_the_model_knows():
    model = Says([0, 0])
    model.n_classes = 4  # type: ignore[attr-defined]
    scores = evaluate(model, windows([0, 0]))
    assert scores.confusion.shape == (4, 4)
    assert (scores.accuracy, scores.f1) == (1, 1)


def test_a_module_without_predict_is_scored_by_its_logits():
    class Bias(nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return torch.tensor([0.0, 2.0, 1.0]).expand(len(x), 3)

    scores = evaluate(Bias(), windows([1, 1, 0, 1]))
    assert scores.accuracy == 0.75
    assert scores.confusion.shape == (3, 3)


def test_scores_print_in_a_line_and_survive_json():
    scores = Scores.of(TRUE, PREDICTED)
    assert str(scores) == "accuracy 0.500, precision 0.333, recall 0.389, F1 0.357 on 6 windows"
    again = Scores.from_dict(json.loads(json.dumps(scores.to_dict(), allow_nan=False)))
    assert again == scores
    assert again != Scores.of(TRUE, TRUE)
    with pytest.raises(ValueError, match="expected schema"):
        Scores.from_dict({"schema": "other"})


def test_what_cannot_be_scored_is_refused():
    with pytest.raises(ValueError, match="no windows"):
        Scores.of([], [])
    with pytest.raises(ValueError, match="1 of 2 windows have no label"):
        Scores.of([0, -1], [0, 0])
    with pytest.raises(ValueError, match="one predicted class for each of 2 windows"):
        Scores.of([0, 1], [0])
    with pytest.raises(TypeError, match="got str"):
        evaluate("model", windows([0]))


def test_the_confusion_can_be_drawn():
    ax = Scores.of(TRUE, PREDICTED).plot(class_names=["a", "b", "c"])
    assert ax.get_title().startswith("accuracy 0.500")
    assert [label.get_text() for label in ax.get_xticklabels()] == ["a", "b", "c"]


def test_scoring_a_plain_classifier_needs_no_torch():
    modules = "adaptfault.evaluation.scores, adaptfault.data.windows, adaptfault.models.store"
    code = f"import sys, {modules}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_interval_counts_recordings_not_windows():
    rng = np.random.default_rng(0)
    right = np.repeat(rng.random(40) < 0.8, 10)  # each recording stands or falls as a whole
    low, high = accuracy_interval(right, np.repeat(np.arange(40), 10))
    p = right.mean()
    assert low < p < high
    assert (high - low) / 2 == pytest.approx(2.02 * np.sqrt(p * (1 - p) / 40), rel=0.05)
    low1, high1 = accuracy_interval(right, np.arange(400))
    assert (high - low) > 2.5 * (high1 - low1)


def test_without_an_error_the_interval_is_the_exact_binomial_one_over_recordings():
    recording = np.repeat(np.arange(10), 10)
    low, high = accuracy_interval(np.ones(100), recording)
    assert (low, high) == pytest.approx((0.025 ** (1 / 10), 1.0))
    low, high = accuracy_interval(np.zeros(100), recording)
    assert (low, high) == pytest.approx((0.0, 1 - 0.025 ** (1 / 10)))


@pytest.mark.parametrize(("mean", "known", "new"), [(0.98, 45, 56), (0.6, 20, 200)])
def test_the_prediction_interval_holds_the_accuracy_on_new_recordings(mean, known, new):
    rng = np.random.default_rng(0)
    held = []
    recording = np.repeat(np.arange(known), 10)
    for _ in range(300):
        # of a window to be right, correlated in a recording by 0.5
        chance = rng.beta(mean, 1 - mean, known + new)
        right = rng.random((known + new, 10)) < chance[:, None]
        low, high = prediction_interval(right[:known].ravel(), recording, new=new)
        held.append(low <= right[known:].mean() <= high)
    assert 0.88 < np.mean(held) < 0.99  # of 0.95; its standard error is 0.013


def test_of_infinitely_many_recordings_the_prediction_interval_is_wilsons():
    from scipy.stats import t
    from statsmodels.stats.proportion import proportion_confint

    # of one window each, so that the effective number is that of a sample
    right = np.arange(50) % 10 > 1
    level = 2 * t.cdf(1.959963985, 49) - 1  # the quantile of t that is the normal one of 95 %
    found = prediction_interval(right, np.arange(50), new=np.inf, level=level)
    effective = 49  # the sample variance has n - 1 degrees of freedom
    assert found == pytest.approx(
        proportion_confint(0.8 * effective, effective, method="wilson"), abs=1e-6
    )


def test_the_prediction_interval_of_perfect_validation_still_has_a_width():
    low, high = prediction_interval(np.ones(100, bool), np.repeat(np.arange(10), 10))
    assert 0.5 < low < 0.9
    assert high == 1.0
    # not a rounding error less
    assert prediction_interval(np.ones(60, bool), np.arange(60))[1] == 1.0
    assert prediction_interval(np.ones(10, bool), np.zeros(10)) == (0.0, 1.0)


def test_a_recording_is_decided_by_all_its_windows():
    from adaptfault.evaluation.scores import of_recording, recording_scores

    likely = np.array([[0.6, 0.4], [0.1, 0.9], [0.6, 0.4], [0.9, 0.1]])
    windows = Windows(
        np.zeros((4, 1, 1), np.float32), np.array([1, 1, 1, 0]), np.array([7, 7, 7, 3])
    )
    scores = recording_scores(likely, windows)
    assert (scores.accuracy, scores.n) == (1.0, 2)
    whole = of_recording(likely[:3])
    assert whole.sum() == pytest.approx(1)
    assert whole.argmax() == likely[:3].prod(axis=0).argmax()
    np.testing.assert_allclose(of_recording(likely[:1]), likely[0])  # one window is itself
