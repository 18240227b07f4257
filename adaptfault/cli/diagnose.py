"""adaptfault diagnose: recordings in, verdicts, root causes and what was not tested out."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from adaptfault.cli.options import Commands, add_recordings, command, emit, load_recordings, say, stream_recordings

if TYPE_CHECKING:
    from adaptfault.data.recordings import Recordings
    from adaptfault.data.recordings.blocks import Stream
    from diagnostics import Diagnosis, SelfDiagnosis

_EXAMPLE = """  adaptfault diagnose today/ --reference healthy/ --out diagnosis.json --picture diagnosis.png
      without --reference the cells are judged by the cells around them"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(commands, "diagnose", "find the faulty cells and wires in a log of recordings", _EXAMPLE)
    add_recordings(parser, labels=False)
    parser.add_argument("--reference", nargs="+", metavar="FILE", help="fault-free recordings of the same array")
    parser.add_argument("--out", metavar="FILE", help="write the diagnosis as JSON")
    parser.add_argument("--picture", metavar="FILE", help="write the verdict map as PNG")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Diagnose; the exit code says how bad it is."""
    from adaptfault.data.recordings.blocks import is_large

    large = args.frames is None and is_large(args.recordings)
    log = stream_recordings(args, args.recordings) if large else load_recordings(args, args.recordings)

    from diagnostics import SelfDiagnosis

    diagnoser = SelfDiagnosis(log.layout)
    if args.reference:
        reference = load_recordings(args, args.reference)
        if reference.layout.shape != log.layout.shape:
            raise ValueError(f"the reference is of {reference.layout}, the log of {log.layout}")
        say(args, f"learning what healthy looks like from {len(reference)} recordings")
        diagnoser.fit(reference.frames)
    diagnosis = _judged(diagnoser, log)
    if args.out:
        Path(args.out).write_text(json.dumps(diagnosis.to_dict(), allow_nan=False))
    if args.picture:
        diagnosis.plot().savefig(args.picture, dpi=150)
    advice = [f"to test more: {touch}" for touch in diagnosis.coverage.advice[:5]]
    emit(args, diagnosis.to_dict(), "\n".join([str(diagnosis), *advice]))
    return diagnosis.exit_code


def _judged(diagnoser: SelfDiagnosis, log: Recordings | Stream) -> Diagnosis:
    """Look at one piece of the log after another: what is remembered of them does not grow."""
    import numpy as np

    from adaptfault.data.recordings import Recordings

    stream = diagnoser.stream()
    for frames in log:
        stream.extend(np.asarray(frames, dtype=np.float64))
    if not isinstance(log, Recordings):
        for problem in log.problems:
            print(problem, file=sys.stderr)
    return diagnoser.evaluate(stream, n_recordings=len(log))
