"""adaptfault predict: the class of each recording, by a model or the version that a bundle runs."""

from __future__ import annotations

import argparse

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

_EXAMPLE = """  adaptfault predict today/ --bundle robot.bundle
      the version that the robot runs: faulty cells are not used
  adaptfault predict today/ --model model --json"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "predict", "name the class of each recording", _EXAMPLE)
    add_recordings(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--model", metavar="MODEL", help="folder written by adaptfault train")
    which.add_argument("--bundle", metavar="BUNDLE", help="the robot's bundle")
    add_device(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Predict; the probabilities of a recording are the mean over its windows."""
    import numpy as np

    from adaptfault.cli.trained_model import TrainedModel
    from adaptfault.data.windows import make_windows

    trained = TrainedModel.open(args, args.model or args.bundle)
    if args.calibration is None and trained.calibration is not None:
        args.calibration = str(trained.calibration)
    recordings = trained.rewired(
        load_recordings(args, args.recordings, layout=trained.network.layout)
    )
    windows = make_windows(
        recordings.frames, None, recordings.layout, length=trained.network.length
    )
    trained.adaptation.model.to(device(args))
    probabilities = trained.adaptation.predict_proba(windows.x)
    names = trained.class_names or tuple(f"class {i}" for i in range(probabilities.shape[1]))
    results = []
    for i, name in enumerate(recordings.names):
        own = probabilities[windows.recording == i]
        mean = own.mean(axis=0) if len(own) else None
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
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(text.ljust(n) for text, n in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    if labelled:
        right = sum(one["class"] == one["label"] for one in results)
        lines.append(f"{right} of {len(results)} recordings are predicted as labelled")
    return "\n".join(lines)
