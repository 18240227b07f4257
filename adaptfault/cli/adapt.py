"""adaptfault adapt: a model and F in, a repaired model out."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import (
    Commands,
    add_recordings,
    command,
    emit,
    fault_set,
    load_recordings,
    progress,
    say,
)

_EXAMPLE = """  adaptfault adapt model grasps/ --faults diagnosis.json --out adapted
      grasps/: the fault-free recordings that the model was trained on"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "adapt", "repair a model for a set of faulty cells", _EXAMPLE)
    parser.add_argument("model", metavar="MODEL", help="folder written by adaptfault train")
    add_recordings(parser)
    parser.add_argument("--faults", required=True, metavar="F", help="a diagnosis (JSON), or cell indices as 3,17,200")
    parser.add_argument("--out", required=True, metavar="FOLDER", help="where the adapted model goes")
    parser.add_argument(
        "--method",
        default="auto",
        choices=("auto", "fill", "head", "finetune", "scratch"),
        help="how far to go (default auto: the first that is good enough)",
    )
    parser.add_argument("--budget", type=float, metavar="S", help="seconds of training allowed")
    parser.add_argument("--seed", type=int, default=0, help="of training (default 0)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Adapt and save."""
    from adaptfault.cli.data import open_model, parts_of

    model, manifest = open_model(args.model)
    faults = fault_set(args.faults, model.layout)
    train, validation, _ = parts_of(load_recordings(args, args.recordings, labelled=True), model, manifest)

    from adaptfault.adaptation import Adapter

    adapter = Adapter(model, train, validation)
    say(args, f"{len(faults)} of {faults.n_cells} cells are faulty; adapting")
    adaptation = adapter.adapt(faults, method=args.method, budget=args.budget, seed=args.seed, progress=progress(args))
    adaptation.save(args.out)
    result = {
        "schema": "adaptfault.adapt/1",
        "adapted": args.out,
        "fault_set": list(faults),
        "fault_free_accuracy": adapter.fault_free_accuracy,
        "scores": adaptation.scores.to_dict(),
        "stages": [vars(stage) for stage in adaptation.stages],
    }
    lines = [
        f"validation, fault-free: accuracy {adapter.fault_free_accuracy:.3f}",
        f"validation, {len(faults)} cells removed: {adaptation.scores}",
        *(f"  {stage}" for stage in adaptation.stages),
        f"adapted model: {args.out}",
    ]
    emit(args, result, "\n".join(lines))
    return 0
