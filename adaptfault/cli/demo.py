"""adaptfault demo: training, faults, diagnosis and repair on simulated grasps or on the user's
recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from adaptfault.cli.inject_option import INJECT_HELP, parse_faults
from adaptfault.cli.options import Commands, add_recordings, command, load_recordings, progress, say
from adaptfault.cli.paths import WrittenFolder

_EXAMPLE = """  adaptfault demo
  adaptfault demo --recordings grasps.npz --epochs 20 --inject random:5=short"""

# The paper has 200 grasps a class and up to 50 epochs at 1e-4. The demo has fewer grasps, a higher
# learning rate and unpadded convolutions, a third of the cost, so that it ends within about a
# minute.
SIMULATED_PER_CLASS = 160
QUICK = {"epochs": 2, "learning_rate": 2e-4, "network": {"padding": "valid", "init": "glorot"}}
_EPOCHS = 20


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "demo", "train, break the sensor, diagnose, repair, write a report", _EXAMPLE
    )
    add_recordings(parser, option=True)
    parser.add_argument(
        "--out",
        type=WrittenFolder,
        default="adaptfault-demo",
        metavar="FOLDER",
        help="default adaptfault-demo",
    )
    parser.add_argument(
        "--epochs", type=int, help="of training (default: 2 simulated, 20 on recordings)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="random seed of the whole run (default 0)"
    )
    parser.add_argument("--inject", action="append", metavar="FAULT", help=INJECT_HELP)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the demo and write the report."""
    import json

    import numpy as np

    if args.recordings:
        recordings = load_recordings(args, args.recordings, labelled=True)
    else:
        from adaptfault.data.simulated_grasps import simulate

        recordings = simulate(SIMULATED_PER_CLASS, seed=args.seed)
    faults = None
    if args.inject:
        faults = parse_faults(args.inject, recordings.layout, np.random.default_rng(args.seed))
    say(args, "loading torch")

    from adaptfault.data.atomic import atomic_write
    from adaptfault.evaluation.demo import run_demo
    from adaptfault.evaluation.html_report import write_report

    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = out / "training.safetensors"
    if checkpoint.exists():
        say(args, f"continuing the training in {checkpoint}")
    result = run_demo(
        recordings,
        faults,
        **({"epochs": _EPOCHS} if args.recordings else QUICK)
        | ({"epochs": args.epochs} if args.epochs else {}),
        seed=args.seed,
        checkpoint=checkpoint,
        progress=progress(args),
        say=(lambda text: say(args, text)) if args.json else lambda text: print(text, flush=True),
    )
    report = write_report(out / "report.html", result)
    checkpoint.unlink(missing_ok=True)
    atomic_write(out / "result.json", json.dumps(result.to_dict(), allow_nan=False).encode())
    if args.json:
        print(json.dumps(result.to_dict(), indent=1, allow_nan=False))
    else:
        print(f"report       {report}")
    return 0
