"""adaptfault simulate: writes simulated grasps, healthy or with injected faults."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import Commands, add_array, command, emit, layout_of, say
from adaptfault.cli.paths import WrittenRecordings
from adaptfault.cli.selection import add_selection, select

_EXAMPLE = """  adaptfault simulate --out grasps.npz
  adaptfault simulate --shape 10x10 --full-scale 3.3 --unit V --grasps 40 --out skin.npz
  adaptfault simulate --grasps 5 --seed 1 --inject row:0:3=open --out broken.npz"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "simulate", "write simulated grasps to try every command with", _EXAMPLE
    )
    parser.add_argument(
        "--out",
        type=WrittenRecordings,
        required=True,
        metavar="PATH",
        help="X.npz, X.npy, X.bag (ROS 2 bag), or a folder for CSV files",
    )
    parser.add_argument(
        "--grasps", type=int, default=40, metavar="N", help="recordings of each class (default 40)"
    )
    parser.add_argument(
        "--frames", type=int, default=100, metavar="T", help="frames of a recording (default 100)"
    )
    parser.add_argument(
        "--classes", nargs="+", metavar="NAME", help="only these classes (default: all seven)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of objects, grasps and noise (default 0)"
    )
    parser.add_argument(
        "--sensor-seed", type=int, default=0, help="of the gain and offset of each cell (default 0)"
    )
    add_array(parser, calibration=False)
    add_selection(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate and write."""
    from adaptfault.data.recordings import save
    from adaptfault.data.recordings.facts.sizes import MOST_BYTES
    from adaptfault.data.simulated_grasps import CLASS_NAMES, simulate

    layout = layout_of(args)
    classes = args.classes or CLASS_NAMES
    if (size := 4 * len(classes) * args.grasps * args.frames * layout.n_cells) > MOST_BYTES:
        raise ValueError(
            f"--grasps {args.grasps} --frames {args.frames}: {size:,} bytes, more than"
            f" {MOST_BYTES:,}"
        )
    say(args, f"simulating {args.grasps} grasps of each class on {layout}")
    recordings = simulate(
        args.grasps,
        layout,
        n_frames=args.frames,
        seed=args.seed,
        classes=classes,
        sensor_seed=args.sensor_seed,
    )
    recordings = select(args, recordings)
    for fact in save(args.out, recordings):
        say(args, f"not stored in this format: {fact}")
    result = {
        "schema": "adaptfault.simulate/1",
        "out": args.out,
        "recordings": len(recordings),
        "layout": recordings.layout.to_dict(),
    }
    emit(args, result, f"{len(recordings)} recordings of {recordings.layout}: {args.out}")
    return 0
