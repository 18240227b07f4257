"""adaptfault info: the content of recordings, and what was inferred about the array."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import Commands, add_recordings, command, emit, load_reported, stream_recordings

_EXAMPLE = """  adaptfault info grasps.npz --picture grasps.png
  adaptfault info today/ --shape 10x10 --full-scale 3.3 --unit V"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands, "info", "show what is in recordings: shape, range, rate, classes, silent cells", _EXAMPLE
    )
    add_recordings(parser)
    parser.add_argument("--picture", metavar="FILE", help="write mean and peak of each cell as PNG")
    parser.set_defaults(run=run, writes=("picture",))


def run(args: argparse.Namespace) -> int:
    """Print the summary."""
    from collections import Counter

    from adaptfault.data.recordings.blocks import is_large
    from adaptfault.data.summary import summarise

    if args.frames is None and is_large(args.recordings):
        stream = stream_recordings(args, args.recordings)
        summary = summarise(stream, stream.layout, inferred=stream.inferred)
    else:
        loaded = load_reported(args, args.recordings)
        recordings, classes = loaded.recordings, {}
        if recordings.labels is not None:
            counts = Counter(recordings.labels.tolist())
            classes = {name: counts[i] for i, name in enumerate(recordings.class_names)}
        summary = summarise(recordings, recordings.layout, classes=classes, inferred=loaded.inferred)
    if args.picture:
        summary.plot().savefig(args.picture, dpi=150)
    emit(args, summary.to_dict(), str(summary))
    return 0
