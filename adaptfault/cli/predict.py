"""adaptfault predict: the class or the values of each recording, by a model or the version that a
bundle runs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from adaptfault.cli.options import (
    Commands,
    add_device,
    add_recordings,
    add_trust,
    command,
    device,
    emit,
    load_recordings,
)
from adaptfault.cli.paths import Read

if TYPE_CHECKING:
    from adaptfault.cli.trained_model import TrainedModel
    from adaptfault.data.recordings import Recordings
    from adaptfault.data.windows import Windows

_EXAMPLE = """  adaptfault predict today/ --bundle robot.bundle
      the version that the robot runs: faulty cells are not used
  adaptfault predict today/ --model model --json"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "predict", "name the class or the values of each recording", _EXAMPLE
    )
    add_recordings(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--model", type=Read, metavar="MODEL", help="folder written by adaptfault train"
    )
    which.add_argument("--bundle", type=Read, metavar="BUNDLE", help="the robot's bundle")
    add_device(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Predict; the probabilities of a recording are those of
    :func:`adaptfault.evaluation.scores.of_recording`, its values the mean over its windows."""
    import numpy as np

    from adaptfault.cli.trained_model import TrainedModel
    from adaptfault.data.windows import make_windows
    from adaptfault.evaluation.scores import of_recording

    trained = TrainedModel.open(args, args.model or args.bundle)
    if args.calibration is None and trained.calibration is not None:
        args.calibration = trained.calibration
    recordings = trained.rewired(
        load_recordings(args, args.recordings, layout=trained.network.layout)
    )
    windows = make_windows(
        recordings.frames, None, recordings.layout, length=trained.network.length
    )
    trained.adaptation.model.to(device(args))
    if trained.is_regression:
        return _values(args, trained, recordings, windows)
    probabilities = trained.adaptation.predict_proba(windows.x)
    names = trained.class_names or tuple(f"class {i}" for i in range(probabilities.shape[1]))
    results = []
    for i, name in enumerate(recordings.names):
        own = probabilities[windows.recording == i]
        mean = of_recording(own) if len(own) else None
        results.append(
            {
                "recording": name,
                "class": None if mean is None else names[int(mean.argmax())],
                "probability": None if mean is None else float(mean.max()),
                "windows": len(own),
                "agreeing_windows": 0
                if mean is None
                else int(np.sum(own.argmax(axis=1) == mean.argmax())),
                "label": None
                if recordings.labels is None
                else recordings.class_names[recordings.labels[i]],
            }
        )
    result = {
        "schema": "adaptfault.predict/1",
        "layout": recordings.layout.to_dict(),
        "class_names": list(names),
        "fault_set": list(trained.adaptation.fault_set),
        "predictions": results,
    }
    emit(args, result, _table(results))
    return 0


def _values(
    args: argparse.Namespace, trained: TrainedModel, recordings: Recordings, windows: Windows
) -> int:
    """Print the values of each recording."""
    predicted = trained.adaptation.predict(windows.x)
    names = trained.class_names or tuple(f"value {i}" for i in range(predicted.shape[1]))
    results: list[dict[str, Any]] = []
    for i, name in enumerate(recordings.names):
        own = predicted[windows.recording == i]
        mean = own.mean(axis=0).tolist() if len(own) else None
        results.append(
            {"recording": name, "values": mean, "windows": len(own), "each": own.tolist()}
        )
    result = {
        "schema": "adaptfault.predict/1",
        "layout": recordings.layout.to_dict(),
        "value_names": list(names),
        "fault_set": list(trained.adaptation.fault_set),
        "predictions": results,
    }
    rows = [("recording", *names, "windows")]
    for one in results:
        shown = (
            ["shorter than a window"]
            if one["values"] is None
            else [*(f"{value:.4g}" for value in one["values"]), str(one["windows"])]
        )
        rows.append((one["recording"], *shown, *[""] * (len(names) + 1 - len(shown))))
    emit(args, result, _aligned(rows))
    return 0


def _aligned(rows: Sequence[tuple[str, ...]]) -> str:
    """Return rows of text in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(n) for text, n in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _table(results: list[dict[str, object]]) -> str:
    """Return one line a recording: name, class, probability, windows, and the label where there is
    one."""
    labelled = any(result["label"] is not None for result in results)
    rows = [("recording", "class", "P", "windows that agree", *(["label"] if labelled else []))]
    for one in results:
        agreeing = f"{one['agreeing_windows']} of {one['windows']}"
        known = one["class"] is not None
        row = (
            (str(one["class"]), f"{one['probability']:.2f}", agreeing)
            if known
            else ("shorter than a window", "", "")
        )
        rows.append((str(one["recording"]), *row, *([str(one["label"])] if labelled else [])))
    lines = [_aligned(rows)]
    if labelled:
        right = sum(one["class"] == one["label"] for one in results)
        lines.append(f"{right} of {len(results)} recordings are predicted as labelled")
    return "\n".join(lines)
