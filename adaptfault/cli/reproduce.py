"""adaptfault reproduce: the paper's figures and claims, on simulated grasps or on the user's own recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from adaptfault.cli.options import Commands, add_recordings, command, emit, load_recordings, progress, say

_EXAMPLE = """  adaptfault reproduce --quick
  adaptfault reproduce --figure 6 --recordings grasps.npz --out real
      killed and started again it goes on where it was"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "reproduce", "repeat the paper's experiments: figures, claims, a page", _EXAMPLE)
    add_recordings(parser, option=True)
    parser.add_argument(
        "--figure",
        type=int,
        action="append",
        choices=(2, 3, 4, 5, 6, 7),
        help="only this figure of the paper (7: its future work); may be given several times",
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="about 15 minutes on two free cores (default)")
    size.add_argument("--full", action="store_true", help="as the paper: 50 epochs, 200k samples; for a GPU")
    parser.add_argument("--seeds", type=int, nargs="+", help="default 0 1 2")
    parser.add_argument("--grasps", type=int, help="simulated grasps of each class (default 200)")
    parser.add_argument("--epochs", type=int, help="of the fault-free network")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default auto)")
    parser.add_argument("--out", default="adaptfault-paper", metavar="FOLDER", help="default adaptfault-paper")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure, draw, write the page."""
    import sys
    from dataclasses import replace

    from adaptfault.paper.settings import Settings

    if args.recordings:
        recordings, source = load_recordings(args, args.recordings, labelled=True), Path(args.recordings[0]).name
    settings = Settings.full() if args.full else Settings.quick(simulated=not args.recordings)
    settings = replace(
        settings,
        seeds=tuple(args.seeds or settings.seeds),
        grasps=args.grasps or settings.grasps,
        epochs=args.epochs or settings.epochs,
    )
    if not args.recordings:
        from adaptfault.grasps import simulate

        say(args, f"simulating {settings.grasps} grasps of each class")
        recordings, source = simulate(settings.grasps), "simulated grasps"
    say(args, "loading torch")

    from adaptfault.paper.run import FIGURES, reproduce

    page = reproduce(
        recordings,
        settings,
        Path(args.out),
        figures=tuple(sorted(set(args.figure))) if args.figure else FIGURES,
        source=source,
        command=" ".join(["adaptfault", *sys.argv[1:]]),
        device=_device(args.device),
        progress=progress(args),
        say=lambda text: say(args, text),
    )
    emit(args, {"schema": "adaptfault.reproduce/1", "page": str(page)}, f"page: {page}")
    return 0


def _device(name: str) -> str:
    """Return the device that networks are trained on.

    Raises:
        ValueError: there is no such device.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {name}: {str(error).splitlines()[0]}; use auto, cpu or cuda") from None
    return name
