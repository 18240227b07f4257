"""adaptfault evaluate: scores of a model or an adaptation, on healthy recordings or with injected
faults."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from adaptfault.cli.inject_option import INJECT_HELP, parse_faults
from adaptfault.cli.options import (
    Commands,
    add_device,
    add_recordings,
    add_trust,
    command,
    device,
    emit,
    say,
)
from adaptfault.cli.paths import Read

if TYPE_CHECKING:
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.windows import Windows

_EXAMPLE = """  adaptfault evaluate model grasps/ --inject random:5=short
  adaptfault evaluate model grasps/ --inject row:0:3=open --adapted adapted"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "evaluate", "score a model on the test recordings", _EXAMPLE)
    parser.add_argument(
        "model", type=Read, metavar="MODEL", help="folder written by adaptfault train, or a bundle"
    )
    add_recordings(parser, targets=True)
    parser.add_argument(
        "--adapted", type=Read, metavar="FOLDER", help="score this adaptation of the model instead"
    )
    parser.add_argument(
        "--head",
        default="auto",
        choices=("auto", "linear"),
        help=(
            "auto: the head that the model was stored with (default); linear: that of its network,"
            " as in the paper"
        ),
    )
    parser.add_argument("--inject", action="append", default=[], metavar="FAULT", help=INJECT_HELP)
    parser.add_argument(
        "--seed", type=int, default=0, help="random seed of random faults (default 0)"
    )
    parser.add_argument(
        "--all", action="store_true", help="score on all recordings, not only on the test share"
    )
    add_device(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Score."""
    import numpy as np

    from adaptfault.adaptation.result import Adaptation
    from adaptfault.cli.trained_model import TrainedModel, say_short
    from diagnostics import inject

    trained = TrainedModel.open(args, args.model)
    model = trained.network
    recordings = trained.rewired(trained.recordings(args, args.recordings))
    classifier = Adaptation.load(args.adapted) if args.adapted else trained.adaptation
    if args.head == "linear":
        classifier.model.head = None
    classifier.model.to(device(args))
    if classifier.fault_set.n_cells != model.layout.n_cells:
        raise ValueError(
            f"{args.adapted}: an adaptation over {classifier.fault_set.n_cells} cells, not of this"
            " model"
        )
    whole = args.all or trained.split_seed is None
    if whole and not args.all:
        say(
            args,
            f"{args.model} does not store the split of its training: scored on all recordings"
            " given",
        )
    say_short(args, recordings, model.length)
    windows = trained.windows(recordings) if whole else trained.parts(recordings)[2]
    rng = np.random.default_rng(args.seed)
    faults = parse_faults(args.inject, recordings.layout, rng)
    if faults:
        which = np.unique(windows.recording)
        broken = [
            inject(r, faults, recordings.layout, seed=args.seed + i) if i in which else r
            for i, r in enumerate(recordings.frames)
        ]
        every = trained.windows(recordings, broken)
        windows = every.select(np.isin(every.recording, which))
    if trained.is_regression:
        result, first, *more = _of_values(classifier, windows, trained.class_names)
    else:
        result, first, *more = _of_classes(classifier, windows)
    cells = {c for fault in faults for c in fault.cells}
    first = f"{len(cells)} cells faulty: {first}" if cells else first
    document = {
        "schema": "adaptfault.evaluate/1",
        **result,
        "injected": [fault.to_dict() for fault in faults],
    }
    emit(args, document, "\n".join([first, *more]))
    return 0


def _of_classes(classifier: Adaptation, windows: Windows) -> tuple[Any, ...]:
    """Return the scores of a classifier as JSON-safe values, and as lines."""
    from adaptfault.evaluation.scores import Scores, accuracy_interval, recording_scores

    probabilities = classifier.predict_proba(windows.x)
    predicted = probabilities.argmax(axis=1)
    scores = Scores.of(windows.y, predicted, n_classes=probabilities.shape[1])
    whole_recordings = recording_scores(probabilities, windows)
    interval = accuracy_interval(predicted == windows.y, windows.sources)
    result = {
        "scores": scores.to_dict(),
        "accuracy_interval": list(interval),
        "recordings": {"accuracy": whole_recordings.accuracy, "n": whole_recordings.n},
    }
    return (
        result,
        str(scores),
        (
            f"95 % interval of the accuracy, clustered by recording: {interval[0]:.3f} to"
            f" {interval[1]:.3f}"
        ),
        (
            "whole recordings, all windows of one together: accuracy"
            f" {whole_recordings.accuracy:.3f} on {whole_recordings.n} recordings"
        ),
    )


def _of_values(regression: Adaptation, windows: Windows, names: Sequence[str]) -> tuple[Any, ...]:
    """Return the scores of a regression as JSON-safe values, and as lines."""
    import numpy as np

    from adaptfault.data.determination import explained
    from adaptfault.evaluation.scores import ValueScores, mean_interval

    predicted = regression.predict(windows.x)
    scores = ValueScores.of(windows.y, predicted)
    result: dict[str, Any] = {"scores": scores.to_dict(), "value_names": list(names)}
    low, high = mean_interval(explained(windows.y, predicted).mean(axis=1), windows.sources)
    if not np.isfinite(low):  # a single recording
        return {**result, "r2_interval": None}, scores.named(names)
    high = min(1.0, high)
    line = f"95 % interval of R2, clustered by recording: {low:.3f} to {high:.3f}"
    return {**result, "r2_interval": [low, high]}, scores.named(names), line
