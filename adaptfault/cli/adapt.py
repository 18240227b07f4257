"""adaptfault adapt: adapts a model to a fault set F, or forecasts its accuracy under F."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from adaptfault.cli.options import (
    Commands,
    add_device,
    add_recordings,
    add_trust,
    command,
    device,
    emit,
    fault_set,
    progress,
    say,
)
from adaptfault.cli.paths import Read, Stated, WrittenFolder

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from diagnostics import FaultSet

_EXAMPLE = """  adaptfault adapt model grasps/ --faults diagnosis.json --out adapted
      grasps/: the fault-free recordings that the model was trained on
  adaptfault adapt model grasps/ --keep adapter
      stores what a robot needs to adapt without the recordings, at most 20 MB; then, on the robot:
  adaptfault adapt adapter --faults 3,17 --forecast"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "adapt", "repair a model for a set of faulty cells", _EXAMPLE)
    parser.add_argument(
        "model",
        type=Read,
        metavar="MODEL",
        help="folder written by adaptfault train or --keep, or a bundle",
    )
    add_recordings(parser, least=0, targets=True)
    parser.add_argument(
        "--faults", type=Stated, metavar="F", help="a diagnosis (JSON), or cell indices as 3,17,200"
    )
    parser.add_argument(
        "--out", type=WrittenFolder, metavar="FOLDER", help="where the adapted model goes"
    )
    parser.add_argument(
        "--forecast",
        action="store_true",
        help="print the accuracy to expect, and adapt only with --out",
    )
    parser.add_argument(
        "--keep",
        type=WrittenFolder,
        metavar="FOLDER",
        help="store everything that later adaptations need, without recordings",
    )
    parser.add_argument(
        "--method",
        default="auto",
        choices=("auto", "fill", "head", "finetune", "scratch"),
        help="method of adaptation (default auto: the first that is accurate enough)",
    )
    parser.add_argument("--budget", type=float, metavar="S", help="seconds of training allowed")
    parser.add_argument("--seed", type=int, default=0, help="random seed of training (default 0)")
    add_device(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Keep the adapter, forecast, adapt and save, as the options state."""
    if args.faults is None and args.keep is None:
        raise ValueError(
            "nothing to do: give --faults F with --out or --forecast, or --keep FOLDER"
        )
    if (args.faults is None) != (args.out is None and not args.forecast):
        raise ValueError(
            "--faults F needs --out FOLDER or --forecast, and either of them needs --faults F"
        )
    adapter = open_adapter(args)
    result: dict[str, Any] = {"schema": "adaptfault.adapt/1"}
    lines: list[str] = []
    if args.keep is not None:
        from adaptfault.adaptation.adapter_files import save_adapter

        save_adapter(args.keep, adapter)
        result["kept"] = args.keep
        lines.append(f"adapter kept: {args.keep}")
    if args.faults is not None:
        faults = fault_set(args.faults, adapter.model.layout)
        adapter = adapter.to(device(args))
        if args.forecast:
            say(
                args,
                f"{len(faults)} of {adapter.model.layout.present.sum()} cells are faulty;"
                " forecasting",
            )
            forecast = adapter.forecast(faults)
            result["forecast"] = forecast.to_dict()
            lines.append(str(forecast))
        if args.out is not None:
            _adapt(args, adapter, faults, result, lines)
    emit(args, result, "\n".join(lines))
    return 0


def open_adapter(args: argparse.Namespace) -> Adapter:
    """Return a kept adapter, a bundle's, or a new one for the model and its recordings."""
    from adaptfault.adaptation.adapter_files import SCHEMA, load_adapter
    from adaptfault.cli.trained_model import TrainedModel, open_bundle
    from adaptfault.models.store import schema_of

    bundle = open_bundle(args, args.model)
    if bundle is not None:
        if args.recordings:
            raise ValueError(f"{args.model} holds its own windows: leave the recordings out")
        return bundle.parts.adapter()
    if schema_of(args.model) == SCHEMA:
        if args.recordings:
            raise ValueError(f"{args.model} holds its own windows: leave the recordings out")
        return load_adapter(args.model)
    from adaptfault.adaptation.adapter import Adapter

    if not args.recordings:
        raise ValueError(
            f"{args.model} is a model: give the fault-free recordings that it was trained on, too"
        )
    trained = TrainedModel.open(args, args.model)
    train, validation, _ = trained.parts(trained.recordings(args, args.recordings))
    return Adapter(trained.network, train, validation)


def _adapt(
    args: argparse.Namespace,
    adapter: Adapter,
    faults: FaultSet,
    result: dict[str, Any],
    lines: list[str],
) -> None:
    verb = "is" if len(faults) == 1 else "are"
    cells = adapter.model.layout.present.sum()
    say(args, f"{len(faults)} of {cells} cells {verb} faulty; adapting")
    adaptation = adapter.adapt(
        faults, method=args.method, budget=args.budget, seed=args.seed, progress=progress(args)
    )
    adaptation.save(args.out)
    result |= {
        "adapted": args.out,
        "fault_set": list(faults),
        "fault_free_accuracy": adapter.fault_free_accuracy,
        "scores": adaptation.scores.to_dict(),
        "stages": [vars(stage) for stage in adaptation.stages],
    }
    sets = adaptation.conformal.size if adaptation.task == "classification" else None
    result["set_size"] = sets
    lines += [
        f"validation, fault-free: {adapter.measure} {adapter.fault_free_accuracy:.3f}",
        f"validation, {len(faults)} cells removed: {adaptation.scores}",
        *([] if sets is None else [f"sets that hold the class at 90 %: {sets:.2f} classes"]),
        *(f"  {stage}" for stage in adaptation.stages),
        f"adapted model: {args.out}",
    ]
