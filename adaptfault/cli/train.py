"""adaptfault train: trains a model on fault-free recordings; writes a model folder or a bundle."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.cli.options import (
    Commands,
    add_device,
    add_recordings,
    add_sign,
    command,
    device,
    emit,
    fit_diagnoser,
    load_recordings,
    progress,
    say,
)

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.data.recordings import Recordings
    from adaptfault.data.windows import Windows
    from adaptfault.evaluation.scores import Scores
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.history import History
    from adaptfault.models.network import TactileTransformer
    from diagnostics import SensorLayout

_CHECKPOINT = "training.safetensors"

_EXAMPLE = """  adaptfault train grasps/ --out model --epochs 20
      grasps/<class>/<recording>.csv; after a crash the same command continues the training
  adaptfault train grasps/ --out robot.bundle
      the folder that a robot carries: for adaptfault maintain and listen"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "train", "train the paper's network on fault-free recordings", _EXAMPLE
    )
    add_recordings(parser)
    parser.add_argument(
        "--out", required=True, metavar="FOLDER", help="where the model goes; X.bundle: a bundle"
    )
    parser.add_argument(
        "--epochs", type=int, default=50, help="at most so many epochs (default 50)"
    )
    parser.add_argument(
        "--learning-rate",
        type=float,
        default=1e-4,
        metavar="X",
        help="of Adam (default 1e-4; small models need more)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="random seed of split, weights and training (default 0)"
    )
    parser.add_argument("--length", type=int, default=10, help="frames in a window (default 10)")
    parser.add_argument(
        "--repairable",
        action="store_true",
        help=(
            "remove random cells while training: imputation alone then repairs more; needs about"
            " twice the epochs"
        ),
    )
    parser.add_argument(
        "--head",
        default="auto",
        choices=("auto", "linear"),
        help=(
            "auto: after training, a head in closed form where it improves validation (default);"
            " linear: the network alone, as in the paper"
        ),
    )
    parser.add_argument(
        "--strict", action="store_true", help="exit code 1 if the training shows a sign of failure"
    )
    parser.add_argument(
        "--model",
        dest="builder",
        metavar="PACKAGE:FUNCTION",
        help=(
            "train the torch module that this function returns for (layout, n_classes, length)"
            " (default: the paper's network)"
        ),
    )
    add_sign(parser, "X.bundle")
    add_device(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train, evaluate on the test recordings, save."""
    out = Path(args.out)
    bundled = out.suffix == ".bundle"
    _check_options(args, out, bundled)
    recordings = load_recordings(args, args.recordings, labelled=True)
    where = device(args)

    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.cli.trained_model import say_short
    from adaptfault.data.windows import make_windows, split
    from adaptfault.evaluation.scores import Scores
    from adaptfault.models.network import TactileTransformer
    from adaptfault.models.store import save_model
    from diagnostics import FaultSet

    windows = make_windows(
        recordings.frames, recordings.labels, recordings.layout, length=args.length
    )
    parts = split(windows, seed=args.seed)
    say(args, f"{recordings.layout}; {windows}")
    say_short(args, recordings, args.length)
    n_classes = len(recordings.class_names)
    model: TactileTransformer | AnyModel
    if args.builder:
        model = _built(args.builder, windows, recordings.layout, n_classes)
    else:
        model = TactileTransformer(recordings.layout, n_classes, length=args.length, seed=args.seed)
    folder = out.with_name(f".{out.name}.training") if bundled else out
    history = _trained(args, model.to(where), parts, folder)
    adapter = Adapter(model.cpu(), parts[0], parts[1])
    healthy = (
        adapter.healthy
        if args.head == "auto"
        else adapter.adapt(FaultSet((), model.layout.n_cells), method="fill")
    )
    scores = Scores.of(parts[2].y, healthy.predict(parts[2].x), n_classes=n_classes)
    extra = {"split_seed": args.seed, "test_scores": scores.to_dict(), "history": history.to_dict()}
    if bundled:
        _bundle(args, out, recordings, adapter, parts)
        shutil.rmtree(folder)
    else:
        save_model(
            out, model, class_names=recordings.class_names, extra=extra, head=healthy.model.head
        )
        (folder / _CHECKPOINT).unlink()  # the run is complete: nothing is left to resume
    problems = _told(args, out, bundled, scores, history, recordings.class_names, extra)
    return int(args.strict and bool(problems))


def _check_options(args: argparse.Namespace, out: Path, bundled: bool) -> None:
    """Refuse what would fail after the training."""
    if bundled and out.exists():
        raise ValueError(f"{out} exists: choose another name, or remove it")
    if args.sign is not None:
        from adaptfault.bundle.signature import read_private_key

        if not bundled:
            raise ValueError("--sign signs bundles: give --out X.bundle")
        read_private_key(args.sign)


def _trained(
    args: argparse.Namespace,
    model: TactileTransformer | AnyModel,
    parts: tuple[Windows, Windows, Windows],
    folder: Path,
) -> History:
    """Train in place; the checkpoint in the folder continues a training that was cut off."""
    from adaptfault.models.training import train

    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / _CHECKPOINT
    if checkpoint.exists():
        say(args, f"continuing from {checkpoint}")
    return train(
        model,
        parts[0],
        parts[1],
        epochs=args.epochs,
        learning_rate=args.learning_rate,
        seed=args.seed,
        repairable=args.repairable,
        checkpoint=checkpoint,
        progress=progress(args),
    )


def _told(
    args: argparse.Namespace,
    out: Path,
    bundled: bool,
    scores: Scores,
    history: History,
    class_names: Sequence[str],
    extra: dict[str, Any],
) -> tuple[str, ...]:
    """Draw the training, print the result, and return the signs of a failed training."""
    from adaptfault.evaluation.training_check import plot_training, training_problems

    kind = "bundle" if bundled else "model"
    picture = out.with_name(f"{out.stem}.training.png") if bundled else out / "training.png"
    plot_training(scores, history, class_names).savefig(picture, dpi=120)
    problems = training_problems(scores, history, class_names)
    for problem in problems:
        print(f"warning: {problem}", file=sys.stderr)
    emit(
        args,
        {
            "schema": "adaptfault.train/1",
            kind: str(out),
            **extra,
            "picture": str(picture),
            "problems": list(problems),
        },
        f"test: {scores}\ntraining: {history}\n{kind}: {out}\npicture: {picture}",
    )
    return problems


def _built(
    builder: str, windows: Windows, layout: SensorLayout, n_classes: int
) -> TactileTransformer | AnyModel:
    """Build the user's model; naming the builder on the command line allows it."""
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.builders import allow_model, build_model
    from adaptfault.models.network import as_tensor

    allow_model(builder)
    model = build_model(builder, layout, n_classes, length=windows.x.shape[1])
    wrapped = AnyModel.probe(model, layout, as_tensor(windows.x[:8]))
    if wrapped.n_classes != n_classes:
        raise ValueError(
            f"--model {builder} has {wrapped.n_classes} outputs, the recordings have {n_classes}"
            " classes"
        )
    return wrapped


def _bundle(
    args: argparse.Namespace,
    out: Path,
    recordings: Recordings,
    adapter: Adapter,
    parts: tuple[Windows, Windows, Windows],
) -> None:
    """Make the bundle; new versions are tested on the windows of the test recordings."""
    import numpy as np

    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.signing import sign_bundle
    from adaptfault.data.calibration import Calibration

    training, _, test = parts
    bundle = Bundle.create(
        out,
        adapter.model,
        adapter,
        fit_diagnoser(args, recordings.select(np.unique(training.recording))),
        check=test,
        class_names=recordings.class_names,
        calibration=Calibration.read(args.calibration) if args.calibration else None,
        head=args.head,
    )
    if args.sign is not None:
        sign_bundle(bundle, args.sign)
