"""Signs of a training that failed."""

import numpy as np
import pytest

from adaptfault.evaluation.scores import Scores
from adaptfault.evaluation.training_check import (
    plot_training,
    rest_level_note,
    training_problems,
)
from adaptfault.models.history import History

NAMES = ("ball", "cup", "pen")
GOOD = History((1.1, 0.6, 0.3), (1.0, 0.7, 0.5), (0.4, 0.7, 0.8), (1.0, 1.0, 1.0), best_epoch=3)


def scores(confusion):
    true = []
    predicted = []
    for (t, p), count in np.ndenumerate(np.asarray(confusion)):
        true += [t] * count
        predicted += [p] * count
    return Scores.of(true, predicted, n_classes=3)


def test_a_training_that_learned_has_no_problem():
    assert training_problems(scores([[30, 3, 3], [4, 28, 2], [1, 4, 31]]), GOOD, NAMES) == ()


@pytest.mark.parametrize(
    ("confusion", "history", "expected"),
    [
        (
            [[12, 12, 12], [11, 13, 12], [13, 10, 12]],
            GOOD,
            "test accuracy 0.346 is near chance (0.336)",
        ),
        (
            [[30, 3, 0], [4, 28, 0], [0, 0, 0]],
            GOOD,
            "class without a window: pen: its recordings are shorter",
        ),
        ([[30, 3, 0], [4, 28, 0], [1, 34, 0]], GOOD, "class never predicted: pen"),
        (
            [[30, 3, 3], [4, 28, 2], [1, 4, 31]],
            History((1.099, 1.1, 1.098), (1.1,) * 3, (0.4,) * 3, (1.0,) * 3, best_epoch=1),
            "the training loss did not fall (1.099 to 1.098)",
        ),
    ],
)
def test_each_sign_of_a_failed_training_is_named_with_likely_causes(confusion, history, expected):
    problems = training_problems(scores(confusion), history, NAMES)
    assert len(problems) == 1
    assert expected in problems[0]


@pytest.mark.usefixtures("all_trees")
@pytest.mark.parametrize("drift", [0.0, 5.0])
def test_rest_levels_that_tell_the_class_raise_a_question(drift):
    rng = np.random.default_rng(0)
    labels = np.arange(60) % 3
    frames = [
        drift * label + rng.normal(0, 1, (30, 8)) + 50 * (np.arange(30) > 20)[:, None]
        for label in labels
    ]
    note = rest_level_note(frames, labels, 0.95)
    assert ("made together?" in note) == (drift > 0)
    assert rest_level_note(frames[:6], labels[:6], 0.95) == ""  # too few to say


def test_the_picture_shows_every_class_and_every_epoch():
    figure = plot_training(scores([[30, 3, 3], [4, 28, 2], [1, 4, 31]]), GOOD, NAMES)
    loss, accuracy, confusion, _ = figure.axes
    assert [len(line.get_xdata()) for line in loss.lines] == [3, 3]
    assert len(accuracy.lines[0].get_xdata()) == 3
    assert [line.get_label() for line in accuracy.lines] == [
        "validation, network in training",
        "test, finished model: 0.840",
    ]
    assert [tick.get_text() for tick in confusion.get_xticklabels()] == list(NAMES)
