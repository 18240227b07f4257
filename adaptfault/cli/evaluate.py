"""adaptfault evaluate: scores of a model or an adaptation, on healthy recordings or with injected
faults."""

from __future__ import annotations

import argparse

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

_EXAMPLE = """  adaptfault evaluate model grasps/ --inject random:5=short
  adaptfault evaluate model grasps/ --inject row:0:3=open --adapted adapted"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "evaluate", "score a model on the test recordings", _EXAMPLE)
    parser.add_argument(
        "model", metavar="MODEL", help="folder written by adaptfault train, or a bundle"
    )
    add_recordings(parser)
    parser.add_argument(
        "--adapted", metavar="FOLDER", help="score this adaptation of the model instead"
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
    from adaptfault.evaluation.scores import Scores, accuracy_interval, recording_scores
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
        from adaptfault.data.windows import make_windows

        every = make_windows(broken, recordings.labels, recordings.layout, length=model.length)
        windows = every.select(np.isin(every.recording, which))
    probabilities = classifier.predict_proba(windows.x)
    predicted = probabilities.argmax(axis=1)
    scores = Scores.of(windows.y, predicted, n_classes=model.n_classes)
    whole_recordings = recording_scores(probabilities, windows)
    interval = accuracy_interval(predicted == windows.y, windows.recording)
    cells = sorted({c for fault in faults for c in fault.cells})
    result = {
        "schema": "adaptfault.evaluate/1",
        "scores": scores.to_dict(),
        "accuracy_interval": list(interval),
        "recordings": {"accuracy": whole_recordings.accuracy, "n": whole_recordings.n},
        "injected": [fault.to_dict() for fault in faults],
    }
    lines = (
        f"{len(cells)} cells faulty: {scores}" if cells else str(scores),
        (
            f"95 % interval of the accuracy, clustered by recording: {interval[0]:.3f} to"
            f" {interval[1]:.3f}"
        ),
        (
            "whole recordings, all windows of one together: accuracy"
            f" {whole_recordings.accuracy:.3f} on {whole_recordings.n} recordings"
        ),
    )
    emit(args, result, "\n".join(lines))
    return 0
