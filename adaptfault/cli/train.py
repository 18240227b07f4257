"""adaptfault train: trains a model on fault-free recordings; writes a model folder or a bundle."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from adaptfault.cli.command import option
from adaptfault.cli.fitting import fit_diagnoser, warn_of_reference
from adaptfault.cli.paths import Read, WrittenFolder, is_bundle
from adaptfault.cli.reading import Reading
from adaptfault.cli.shared_options import chosen_device, device_option, sign_option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.recordings import Recordings
    from adaptfault.data.windows import Windows
    from adaptfault.evaluation.scores import Scores, ValueScores
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.history import History
    from adaptfault.models.network import TactileTransformer
    from adaptfault.models.value_units import ValueUnits
    from diagnostics import SensorLayout

_SOON = 3  # epochs after which a training should be above chance
_CHECKPOINT = "training.safetensors"


class Train(Reading):
    """Train the paper's network on fault-free recordings."""

    takes_targets = True
    example = """  adaptfault train grasps/ --out model --epochs 20
      grasps/<class>/<recording>.csv; after a crash the same command continues the training
  adaptfault train grasps/ --out robot.bundle
      the folder that a robot carries: for adaptfault maintain and listen
  adaptfault train grasps/ --targets targets.csv --out model
      a regression; targets.csv: file,force,row,column"""
    continues = True

    out: WrittenFolder = option("where the model goes; X.bundle: a bundle", "FOLDER", required=True)
    epochs: int = option("at most so many epochs (default 50)", default=50)
    learning_rate: float = option(
        "of Adam (default 1e-4; small models need more)", "X", default=1e-4
    )
    seed: int = option("random seed of split, weights and training (default 0)", default=0)
    length: int = option("frames in a window (default 10)", default=10)
    repairable: bool = option(
        "remove random cells while training: imputation alone then repairs more; needs about"
        " twice the epochs"
    )
    head: Literal["auto", "linear"] = option(
        "auto: after training, a head in closed form where it improves validation (default);"
        " linear: the network alone, as in the paper",
        default="auto",
    )
    strict: bool = option(
        "exit code 1 if recordings show faults, or the training a sign of failure"
    )
    builder: str | None = option(
        "train the torch module that this function returns for (layout, n_classes, length)"
        " (default: the paper's network)",
        "PACKAGE:FUNCTION",
        flag="--model",
    )
    sign: Read | None = sign_option("X.bundle")
    device: str = device_option()

    @property
    def path(self) -> Path:
        """Of the model or the bundle."""
        return Path(self.out)

    @property
    def bundled(self) -> bool:
        """Whether a bundle is made."""
        return self.path.suffix == ".bundle"

    @property
    def folder(self) -> Path:
        """Folder of the checkpoint while the training runs."""
        return self.path.with_name(f".{self.path.name}.training") if self.bundled else self.path

    def run(self) -> int:
        """Train, evaluate on the test recordings, save."""
        if self.bundled and _was_done(self):
            return 0
        _check_options(self)
        recordings = self.load(self.recordings, labelled=True)
        where = chosen_device(self.device)
        if _shows_faults(recordings) and self.strict:
            return 1
        _check_classes(self.recordings[0], recordings)

        from adaptfault.adaptation.adapter import Adapter
        from adaptfault.cli.trained_model import say_short
        from adaptfault.data.windows import make_windows, split
        from diagnostics import FaultSet

        layout = recordings.layout
        values = recordings.targets is not None
        names = recordings.value_names if values else recordings.class_names
        targets = recordings.targets if values else recordings.labels
        windows = make_windows(recordings.frames, targets, layout, length=self.length)
        parts = split(windows, seed=self.seed)
        self.say(f"{layout}; {windows}")
        say_short(self, recordings, self.length)
        units = _units(self, names, parts[0]) if values else None
        model = _model(self, windows, layout, len(names), values)
        history = _trained(self, model.to(where), parts, units)
        adapter = Adapter(model.cpu(), parts[0], parts[1])
        healthy = adapter.healthy
        if self.head == "linear":
            healthy = adapter.adapt(FaultSet((), layout.n_cells), method="fill")
        predicted = healthy.predict(parts[2].x)
        scores = _scores(parts[2], predicted, len(names), values)
        extra = {
            "split_seed": self.seed,
            "test_scores": scores.to_dict(),
            "history": history.to_dict(),
        }
        if units is not None:
            extra["units"] = units.to_dict(names)
        if self.bundled:
            _bundle(self, recordings, adapter, parts, names)
        else:
            _save(self, adapter, healthy, names, extra)
        _note_rest_levels(self, recordings, scores)
        problems = _told(self, scores, history, names, extra, (parts[2].y, predicted))
        return int(self.strict and bool(problems))


add = Train.add


def _scores(
    test: Windows, predicted: NDArray[Any], n_classes: int, values: bool
) -> Scores | ValueScores:
    from adaptfault.evaluation.scores import Scores, ValueScores

    if values:
        return ValueScores.of(test.y, predicted)
    return Scores.of(test.y, predicted, n_classes=n_classes)


def _note_rest_levels(args: Train, recordings: Recordings, scores: Scores | ValueScores) -> None:
    """Say where classes differ in what untouched cells read."""
    from adaptfault.evaluation.scores import Scores
    from adaptfault.evaluation.training_check import rest_level_note

    if isinstance(scores, Scores) and recordings.labels is not None:
        note = rest_level_note(recordings.frames, recordings.labels, scores.accuracy)
        if note:
            args.say(note)


def _save(
    args: Train,
    adapter: Adapter,
    healthy: Adaptation,
    names: Sequence[str],
    extra: Mapping[str, Any],
) -> None:
    from adaptfault.models.store import save_model

    save_model(
        args.path,
        adapter.model,
        class_names=names,
        extra=extra,
        head=healthy.model.head,
        task=adapter.task,
    )
    (args.folder / _CHECKPOINT).unlink()  # the run is complete: nothing is left to resume


def _shows_faults(recordings: Recordings) -> bool:
    """Warn of cells that are dead in some of the recordings; return whether there are any."""
    from diagnostics import SelfDiagnosis

    findings = SelfDiagnosis(recordings.layout).judge(recordings.frames, classes=recordings.labels)
    warn_of_reference(findings, recordings.names)
    return bool(findings)


def _check_classes(path: str, recordings: Recordings) -> None:
    """Refuse recordings of one class.

    Raises:
        ValueError: there are no two classes.
    """
    if recordings.labels is None or recordings.targets is not None:
        return
    present = set(recordings.labels.tolist())
    if len(present) == 1:
        name = recordings.class_names[present.pop()]
        raise ValueError(
            f"{path}: all recordings are of one class, {name!r}; a classifier needs two, one folder"
            " each"
        )


def _was_done(args: Train) -> bool:
    """Return whether a run of this command was cut off after its bundle was whole, and end it.

    Raises:
        Untrusted: the bundle is to be signed, and is not.
    """
    out = args.path
    if not (args.folder.is_dir() and is_bundle(out)):
        return False
    from adaptfault.bundle.bundle import Bundle

    Bundle.open(out, keys=None if args.sign is None else [args.sign])
    shutil.rmtree(args.folder)
    result = {"schema": "adaptfault.train/1", "bundle": str(out)}
    args.emit(result, f"bundle: {out}, whole; the run that made it was cut off at its end")
    return True


def _check_options(args: Train) -> None:
    """Refuse what would fail after the training."""
    if args.bundled and args.path.exists():
        raise ValueError(f"{args.path} exists: choose another name, or remove it")
    if args.sign is not None:
        from adaptfault.bundle.signature import read_private_key

        if not args.bundled:
            raise ValueError("--sign signs bundles: give --out X.bundle")
        read_private_key(args.sign)


def _trained(
    args: Train,
    model: TactileTransformer | AnyModel,
    parts: tuple[Windows, Windows, Windows],
    units: ValueUnits | None,
) -> History:
    """Train in place; the checkpoint in the folder continues a training that was cut off.

    A regression trains on values in ``units``, which its last layer then takes up.
    """
    from adaptfault.models.training import train

    args.folder.mkdir(parents=True, exist_ok=True)
    checkpoint = args.folder / _CHECKPOINT
    if checkpoint.exists():
        args.say(f"continuing from {checkpoint}")
    training, validation = parts[:2]
    if units is not None:
        training = units.standardised(training)
        validation = units.standardised(validation)
    history = train(
        model,
        training,
        validation,
        epochs=args.epochs,
        learning_rate=args.learning_rate,
        seed=args.seed,
        repairable=args.repairable,
        checkpoint=checkpoint,
        on_epoch=_epoch_line(args, training, units),
        progress=args.progress,
    )
    if units is not None:
        units.fold(model)
    return history


def _epoch_line(
    args: Train, training: Windows, units: ValueUnits | None
) -> Callable[[History], None]:
    """Return what tells on stderr a training that is at chance after a few epochs, and each epoch
    where no bar is shown."""
    from adaptfault.evaluation.scores import chance

    share, limit = (0.0, -math.inf) if units is not None else chance(training.y)
    guess = "" if units is not None else f" (guessing reaches {share:.3f})"
    measure = "R2" if units is not None else "accuracy"

    def told(history: History) -> None:
        done = history.epochs
        if done == _SOON and max(history.validation_accuracy) < limit:
            args.say(
                f"at chance after {done} epochs: if this lasts, the classes do not differ in what"
                " the cells read, the labels are mixed up, or a higher --learning-rate is needed"
            )
        if sys.stderr.isatty():
            return
        left = sum(history.seconds) / done * (args.epochs - done)
        reached = f"validation {measure} {history.validation_accuracy[-1]:.3f}"
        args.say(f"epoch {done} of {args.epochs}: {reached}{guess}, about {left:.0f} s left")

    return told


def _units(args: Train, names: Sequence[str], training: Windows) -> ValueUnits:
    """Return the units of the values.

    Raises:
        ValueError: a value is the same in all training windows.
    """
    from adaptfault.models.value_units import ValueUnits

    for name, values in zip(names, training.y.T, strict=True):
        if values.min() == values.max():
            raise ValueError(
                f"{args.targets}: {name} is {values[0]:g} in all training recordings, so nothing"
                " can be learned of it: leave the column out, or add recordings with other values"
            )
    return ValueUnits.of(training)


def _told(
    args: Train,
    scores: Scores | ValueScores,
    history: History,
    names: Sequence[str],
    extra: dict[str, Any],
    values: tuple[NDArray[Any], NDArray[Any]],
) -> tuple[str, ...]:
    """Draw the training, print the result, and return the signs of a failed training."""
    from adaptfault.data.atomic import atomic_figure
    from adaptfault.evaluation.scores import ValueScores
    from adaptfault.evaluation.training_check import (
        plot_training,
        plot_value_training,
        training_problems,
        value_training_problems,
    )

    out = args.path
    kind = "model"
    picture = out / "training.png"
    if args.bundled:
        kind = "bundle"
        picture = out.with_name(f"{out.stem}.training.png")
    if isinstance(scores, ValueScores):
        figure = plot_value_training(*values, scores, history, names)
        problems = value_training_problems(scores, history)
        told = scores.named(names)
        trained = history.told("R2")
    else:
        figure = plot_training(scores, history, names)
        problems = training_problems(scores, history, names)
        told = str(scores)
        trained = str(history)
    atomic_figure(picture, figure, dpi=120)
    for problem in problems:
        print(f"warning: {problem}", file=sys.stderr)
    args.emit(
        {
            "schema": "adaptfault.train/1",
            kind: str(out),
            **extra,
            "picture": str(picture),
            "problems": list(problems),
        },
        f"test: {told}\ntraining: {trained}\n{kind}: {out}\npicture: {picture}",
    )
    return problems


def _model(
    args: Train, windows: Windows, layout: SensorLayout, n_classes: int, values: bool
) -> TactileTransformer | AnyModel:
    """Return the paper's network, or the user's: naming its builder on the command line allows
    it."""
    if args.builder is None:
        from adaptfault.models.network import TactileTransformer

        return TactileTransformer(layout, n_classes, length=args.length, seed=args.seed)
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.builders import allow_model, build_model
    from adaptfault.models.network import as_tensor
    from adaptfault.models.value_units import foldable

    allow_model(args.builder)
    model = build_model(args.builder, layout, n_classes, length=args.length)
    wrapped = AnyModel.probe(model, layout, as_tensor(windows.x[:8]))
    if wrapped.n_classes != n_classes:
        raise ValueError(
            f"--model {args.builder} has {wrapped.n_classes} outputs, the recordings have"
            f" {n_classes} {'values' if values else 'classes'}"
        )
    if values and not foldable(wrapped):
        raise ValueError(
            f"--model {args.builder} does not end with a nn.Linear with a bias, which takes up the"
            " units of the values: end the module with one"
        )
    return wrapped


def _bundle(
    args: Train,
    recordings: Recordings,
    adapter: Adapter,
    parts: tuple[Windows, Windows, Windows],
    names: Sequence[str],
) -> None:
    """Make the bundle; new versions are tested on the windows of the test recordings."""
    import numpy as np

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.data.calibration import Calibration

    training, _, test = parts
    Bundle.create(
        args.path,
        adapter.model,
        adapter,
        fit_diagnoser(args, recordings.select(np.unique(training.recording)), told=False),
        check=test,
        class_names=names,
        calibration=Calibration.read(args.calibration) if args.calibration else None,
        head=args.head,
        sign=args.sign,
    )
    shutil.rmtree(args.folder)
