"""adaptfault predict: the class or the values of each recording, by a model or the version that a
bundle runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import option
from adaptfault.cli.paths import Read
from adaptfault.cli.reading import Reading
from adaptfault.cli.shared_options import Trusting, chosen_device, device_option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


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
        from adaptfault.cli.trained_model import TrainedModel
        from adaptfault.data.windows import make_windows

        trained = TrainedModel.open(self, str(self.model or self.bundle))
        if self.calibration is None and trained.calibration is not None:
            self.calibration = trained.calibration
        recordings = trained.rewired(self.load(self.recordings, layout=trained.network.layout))
        windows = make_windows(
            recordings.frames, None, recordings.layout, length=trained.network.length
        )
        trained.adaptation.model.to(chosen_device(self.device))
        if trained.is_regression:
            kind, of_recording, table = "value", _values, _table_of_values
            outputs = trained.adaptation.predict(windows.x)
        else:
            kind, of_recording, table = "class", _class, _table_of_classes
            outputs = trained.adaptation.predict_proba(windows.x)
        names = trained.class_names or tuple(f"{kind} {i}" for i in range(outputs.shape[1]))
        results = []
        for i, name in enumerate(recordings.names):
            own = outputs[windows.recording == i]
            about = {"recording": name, **of_recording(own, names), "windows": len(own)}
            if kind == "class":
                labels = recordings.labels
                about["label"] = None if labels is None else recordings.class_names[labels[i]]
            results.append(about)
        result = {
            "schema": "adaptfault.predict/1",
            "layout": recordings.layout.to_dict(),
            f"{kind}_names": list(names),
            "fault_set": list(trained.adaptation.fault_set),
            "predictions": results,
        }
        self.emit(result, table(results, names))
        return 0


add = Predict.add


def _class(own: NDArray[np.float32], names: Sequence[str]) -> dict[str, Any]:
    """Return what the probabilities of the windows of a recording say of it."""
    from adaptfault.evaluation.scores import of_recording

    if not len(own):
        return {"class": None, "probability": None, "agreeing_windows": 0}
    mean = of_recording(own)
    best = int(mean.argmax())
    agreeing = int((own.argmax(axis=1) == best).sum())
    return {"class": names[best], "probability": float(mean[best]), "agreeing_windows": agreeing}


def _values(own: NDArray[np.float32], names: Sequence[str]) -> dict[str, Any]:
    """Return the values of a recording, and of each of its windows."""
    return {"values": own.mean(axis=0).tolist() if len(own) else None, "each": own.tolist()}


def _table_of_values(results: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    """Return one line a recording: name, values, windows."""
    rows = [("recording", *names, "windows")]
    for one in results:
        shown = ["shorter than a window"]
        if one["values"] is not None:
            shown = [*(f"{value:.4g}" for value in one["values"]), str(one["windows"])]
        rows.append((one["recording"], *shown, *[""] * (len(names) + 1 - len(shown))))
    return _aligned(rows)


def _aligned(rows: Sequence[tuple[str, ...]]) -> str:
    """Return rows of text in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(n) for text, n in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _table_of_classes(results: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
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
