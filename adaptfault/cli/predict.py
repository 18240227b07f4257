"""adaptfault predict: the class or the values of each recording, by a model or the version that a
bundle runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import option
from adaptfault.cli.paths import Read
from adaptfault.cli.reading import Reading
from adaptfault.cli.shared_options import Trusting, chosen_device, device_option

if TYPE_CHECKING:
    from adaptfault.cli.trained_model import TrainedModel
    from adaptfault.data.recordings import Recordings
    from adaptfault.data.windows import Windows


class Predict(Trusting, Reading):
    """Name the class or the values of each recording."""

    example = """  adaptfault predict today/ --bundle robot.bundle
      the version that the robot runs: faulty cells are not used
  adaptfault predict today/ --model model --json"""
    one_of = ("model", "bundle")
    one_is_needed = True

    model: Read | None = option("folder written by adaptfault train", "MODEL")
    bundle: Read | None = option("the robot's bundle", "BUNDLE")
    device: str = device_option()

    def run(self) -> int:
        """Predict; the probabilities of a recording are those of
        :func:`adaptfault.evaluation.scores.of_recording`, its values the mean over its windows."""
        import numpy as np

        from adaptfault.cli.trained_model import TrainedModel
        from adaptfault.data.windows import make_windows
        from adaptfault.evaluation.scores import of_recording

        trained = TrainedModel.open(self, str(self.model or self.bundle))
        if self.calibration is None and trained.calibration is not None:
            self.calibration = trained.calibration
        recordings = trained.rewired(self.load(self.recordings, layout=trained.network.layout))
        windows = make_windows(
            recordings.frames, None, recordings.layout, length=trained.network.length
        )
        trained.adaptation.model.to(chosen_device(self.device))
        if trained.is_regression:
            return _values(self, trained, recordings, windows)
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
        self.emit(result, _table(results))
        return 0


add = Predict.add


def _values(args: Predict, trained: TrainedModel, recordings: Recordings, windows: Windows) -> int:
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
    args.emit(result, _aligned(rows))
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
