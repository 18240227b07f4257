"""adaptfault reproduce: the paper's figures and claims, on simulated grasps or on the user's own
recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from adaptfault.cli.options import (
    Commands,
    add_device,
    add_recordings,
    command,
    device,
    emit,
    load_recordings,
    progress,
    say,
)
from adaptfault.cli.paths import WrittenFolder

_EXAMPLE = """  adaptfault reproduce --quick
  adaptfault reproduce --figure 6 --recordings grasps.npz --out real
      after a crash the same command continues"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "reproduce", "repeat the paper's experiments: figures, claims, a page", _EXAMPLE
    )
    add_recordings(parser, option=True)
    parser.add_argument(
        "--figure",
        type=int,
        action="append",
        choices=(2, 3, 4, 5, 6, 7),
        help="only this figure of the paper (7: its future work); may be given several times",
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--quick", action="store_true", help="about 14 minutes on two free cores (default)"
    )
    size.add_argument(
        "--full", action="store_true", help="as the paper: 50 epochs, 200k samples; for a GPU"
    )
    parser.add_argument("--seeds", type=int, nargs="+", help="default 0 1 2")
    parser.add_argument("--grasps", type=int, help="simulated grasps of each class (default 200)")
    parser.add_argument("--epochs", type=int, help="of the fault-free network")
    parser.add_argument(
        "--samples",
        type=int,
        nargs="+",
        metavar="N",
        help="windows added in fault-aware training (--quick: 10000)",
    )
    add_device(parser)
    parser.add_argument(
        "--out",
        type=WrittenFolder,
        default="adaptfault-paper",
        metavar="FOLDER",
        help="default adaptfault-paper",
    )
    parser.set_defaults(run=run, continues=True)


def run(args: argparse.Namespace) -> int:
    """Measure, draw, write the page."""
    import sys
    from dataclasses import replace

    from adaptfault.paper.settings import Settings

    if args.recordings:
        recordings, source = (
            load_recordings(args, args.recordings, labelled=True),
            Path(args.recordings[0]).name,
        )
    if args.samples and min(args.samples) < 1:
        raise ValueError(
            f"--samples {min(args.samples)}: fault-aware training adds 1 window or more"
        )
    settings = Settings.full() if args.full else Settings.quick(simulated=not args.recordings)
    settings = replace(
        settings,
        seeds=tuple(args.seeds or settings.seeds),
        grasps=args.grasps or settings.grasps,
        epochs=args.epochs or settings.epochs,
        samples=tuple(sorted(set(args.samples or settings.samples))),
    )
    if not args.recordings:
        from adaptfault.data.simulated_grasps import simulate

        say(args, f"simulating {settings.grasps} grasps of each class")
        recordings = simulate(settings.grasps)
        source = "simulated grasps"
    say(args, "loading torch")

    from adaptfault.paper.run import FIGURES, reproduce

    page = reproduce(
        recordings,
        settings,
        Path(args.out),
        figures=tuple(sorted(set(args.figure))) if args.figure else FIGURES,
        source=source,
        command=" ".join(["adaptfault", *sys.argv[1:]]),
        device=device(args),
        progress=progress(args),
        say=lambda text: say(args, text),
    )
    emit(args, {"schema": "adaptfault.reproduce/1", "page": str(page)}, f"page: {page}")
    return 0
