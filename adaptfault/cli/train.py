"""adaptfault train: trains a model on fault-free recordings; writes a model folder or a bundle."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable, Sequence
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

    def run(self) -> int:
        """Train, evaluate on the test recordings, save."""
        out = Path(self.out)
        bundled = out.suffix == ".bundle"
        if bundled and _was_done(self, out):
            return 0
        _check_options(self, out, bundled)
        recordings = self.load(self.recordings, labelled=True)
        where = chosen_device(self.device)
        if _shows_faults(recordings) and self.strict:
            return 1

        from adaptfault.adaptation.adapter import Adapter
        from adaptfault.cli.trained_model import say_short
        from adaptfault.data.windows import make_windows, split
        from adaptfault.evaluation.scores import Scores, ValueScores
        from adaptfault.models.network import TactileTransformer
        from adaptfault.models.store import save_model
        from diagnostics import FaultSet

        values = recordings.targets is not None
        names = recordings.value_names if values else recordings.class_names
        _check_classes(self.recordings[0], recordings)
        windows = make_windows(
            recordings.frames,
            recordings.targets if values else recordings.labels,
            recordings.layout,
            length=self.length,
        )
        parts = split(windows, seed=self.seed)
        self.say(f"{recordings.layout}; {windows}")
        say_short(self, recordings, self.length)
        n_classes = len(names)
        units = _units(self, names, parts[0]) if values else None
        model: TactileTransformer | AnyModel
        if self.builder:
            model = _built(self.builder, windows, recordings.layout, n_classes, values)
        else:
            model = TactileTransformer(
                recordings.layout, n_classes, length=self.length, seed=self.seed
            )
        folder = _training_folder(out) if bundled else out
        history = _trained(self, model.to(where), parts, folder, units)
        adapter = Adapter(model.cpu(), parts[0], parts[1])
        healthy = (
            adapter.healthy
            if self.head == "auto"
            else adapter.adapt(FaultSet((), model.layout.n_cells), method="fill")
        )
        predicted = healthy.predict(parts[2].x)
        scores: Scores | ValueScores
        if units is None:
            scores = Scores.of(parts[2].y, predicted, n_classes=n_classes)
        else:
            scores = ValueScores.of(parts[2].y, predicted)
        extra = {
            "split_seed": self.seed,
            "test_scores": scores.to_dict(),
            "history": history.to_dict(),
        }
        if units is not None:
            extra["units"] = units.to_dict(names)
        if bundled:
            _bundle(self, out, recordings, adapter, parts, names)
            shutil.rmtree(folder)
        else:
            save_model(
                out,
                model,
                class_names=names,
                extra=extra,
                head=healthy.model.head,
                task=adapter.task,
            )
            (folder / _CHECKPOINT).unlink()  # the run is complete: nothing is left to resume
        if isinstance(scores, Scores) and recordings.labels is not None:
            from adaptfault.evaluation.training_check import rest_level_note

            if note := rest_level_note(recordings.frames, recordings.labels, scores.accuracy):
                self.say(note)
        problems = _told(self, out, bundled, scores, history, names, extra, (parts[2].y, predicted))
        return int(self.strict and bool(problems))


add = Train.add


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


def _training_folder(out: Path) -> Path:
    """Return the folder of the checkpoint while a bundle is made."""
    return out.with_name(f".{out.name}.training")


def _was_done(args: Train, out: Path) -> bool:
    """Return whether a run of this command was cut off after its bundle was whole, and end it.

    Raises:
        Untrusted: the bundle is to be signed, and is not.
    """
    folder = _training_folder(out)
    if not (folder.is_dir() and is_bundle(out)):
        return False
    from adaptfault.bundle.bundle import Bundle

    Bundle.open(out, keys=None if args.sign is None else [args.sign])
    shutil.rmtree(folder)
    result = {"schema": "adaptfault.train/1", "bundle": str(out)}
    args.emit(result, f"bundle: {out}, whole; the run that made it was cut off at its end")
    return True


def _check_options(args: Train, out: Path, bundled: bool) -> None:
    """Refuse what would fail after the training."""
    if bundled and out.exists():
        raise ValueError(f"{out} exists: choose another name, or remove it")
    if args.sign is not None:
        from adaptfault.bundle.signature import read_private_key

        if not bundled:
            raise ValueError("--sign signs bundles: give --out X.bundle")
        read_private_key(args.sign)


def _trained(
    args: Train,
    model: TactileTransformer | AnyModel,
    parts: tuple[Windows, Windows, Windows],
    folder: Path,
    units: ValueUnits | None,
) -> History:
    """Train in place; the checkpoint in the folder continues a training that was cut off.

    A regression trains on values in ``units``, which its last layer then takes up.
    """
    from adaptfault.models.training import train

    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / _CHECKPOINT
    if checkpoint.exists():
        args.say(f"continuing from {checkpoint}")
    training, validation = parts[:2]
    if units is not None:
        training, validation = units.standardised(training), units.standardised(validation)
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
    out: Path,
    bundled: bool,
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

    kind = "bundle" if bundled else "model"
    picture = out.with_name(f"{out.stem}.training.png") if bundled else out / "training.png"
    if isinstance(scores, ValueScores):
        figure = plot_value_training(*values, scores, history, names)
        problems = value_training_problems(scores, history)
        told, trained = scores.named(names), history.told("R2")
    else:
        figure = plot_training(scores, history, names)
        problems = training_problems(scores, history, names)
        told, trained = str(scores), str(history)
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


def _built(
    builder: str, windows: Windows, layout: SensorLayout, n_classes: int, values: bool
) -> TactileTransformer | AnyModel:
    """Build the user's model; naming the builder on the command line allows it."""
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.builders import allow_model, build_model
    from adaptfault.models.network import as_tensor
    from adaptfault.models.value_units import foldable

    allow_model(builder)
    model = build_model(builder, layout, n_classes, length=windows.x.shape[1])
    wrapped = AnyModel.probe(model, layout, as_tensor(windows.x[:8]))
    if wrapped.n_classes != n_classes:
        raise ValueError(
            f"--model {builder} has {wrapped.n_classes} outputs, the recordings have {n_classes}"
            f" {'values' if values else 'classes'}"
        )
    if values and not foldable(wrapped):
        raise ValueError(
            f"--model {builder} does not end with a nn.Linear with a bias, which takes up the units"
            " of the values: end the module with one"
        )
    return wrapped


def _bundle(
    args: Train,
    out: Path,
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
        out,
        adapter.model,
        adapter,
        fit_diagnoser(args, recordings.select(np.unique(training.recording)), told=False),
        check=test,
        class_names=names,
        calibration=Calibration.read(args.calibration) if args.calibration else None,
        head=args.head,
        sign=args.sign,
    )
