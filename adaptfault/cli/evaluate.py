"""adaptfault evaluate: scores of a model or an adaptation, on healthy recordings or with injected
faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from adaptfault.cli.command import argument, option
from adaptfault.cli.inject_option import INJECT_HELP, parse_faults
from adaptfault.cli.paths import Read
from adaptfault.cli.reading import Reading
from adaptfault.cli.shared_options import Trusting, chosen_device, device_option

if TYPE_CHECKING:
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.windows import Windows


class Evaluate(Trusting, Reading):
    """Score a model on the test recordings."""

    takes_targets = True
    example = """  adaptfault evaluate model grasps/ --inject random:5=short
  adaptfault evaluate model grasps/ --inject row:0:3=open --adapted adapted"""

    model: Read = argument("folder written by adaptfault train, or a bundle", "MODEL")
    adapted: Read | None = option("score this adaptation of the model instead", "FOLDER")
    head: Literal["auto", "linear"] = option(
        "auto: the head that the model was stored with (default); linear: that of its network,"
        " as in the paper",
        default="auto",
    )
    inject: list[str] = option(INJECT_HELP, "FAULT", default=[], action="append")
    seed: int = option("random seed of random faults (default 0)", default=0)
    all: bool = option("score on all recordings, not only on the test share")
    device: str = device_option()

    def run(self) -> int:
        """Score."""
        import numpy as np

        from adaptfault.adaptation.result import Adaptation
        from adaptfault.cli.trained_model import TrainedModel, say_short
        from diagnostics import inject

        trained = TrainedModel.open(self, self.model)
        model = trained.network
        recordings = trained.rewired(trained.recordings(self, self.recordings))
        classifier = Adaptation.load(self.adapted) if self.adapted else trained.adaptation
        if self.head == "linear":
            classifier.model.head = None
        classifier.model.to(chosen_device(self.device))
        if classifier.fault_set.n_cells != model.layout.n_cells:
            raise ValueError(
                f"{self.adapted}: an adaptation over {classifier.fault_set.n_cells} cells, not of"
                " this model"
            )
        whole = self.all or trained.split_seed is None
        if whole and not self.all:
            self.say(
                f"{self.model} does not store the split of its training: scored on all recordings"
                " given"
            )
        say_short(self, recordings, model.length)
        windows = trained.windows(recordings) if whole else trained.parts(recordings)[2]
        rng = np.random.default_rng(self.seed)
        faults = parse_faults(self.inject, recordings.layout, rng)
        if faults:
            which = np.unique(windows.recording)
            broken = [
                inject(r, faults, recordings.layout, seed=self.seed + i) if i in which else r
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
        self.emit(document, "\n".join([first, *more]))
        return 0


add = Evaluate.add


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
