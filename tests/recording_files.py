"""Recordings written to files, and what the reader says of them, for the tests of each format."""

from pathlib import Path

import numpy as np
import pytest

from adaptfault.data.recordings import InputError, load
from adaptfault.data.recordings.formats import csv_folder, spans
from diagnostics import SensorLayout

SDH = Path(__file__).parents[2] / "shared/data/sdh2x13x6_grasps36.npz"
PAPER = SensorLayout.paper()
SMALL = SensorLayout(1, 2, 3)
rng = np.random.default_rng(0)


def newtons(frames=100, cells=220):
    return rng.uniform(0, 4.9, (frames, cells)).round(3)


def text(values):
    return "".join(",".join(f"{v:g}" for v in row) + "\n" for row in np.atleast_2d(values))


def write(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(values if isinstance(values, str) else text(values))
    return path


def messages(loaded, level):
    return [problem.message for problem in loaded.problems if problem.level == level]


def refusal(*args, **options):
    """Return the one line that a load is refused with."""
    with pytest.raises(InputError) as caught:
        load(*args, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def archive(path, **arrays):
    np.savez(path, **arrays)
    return path


def counts(n=3, frames=8, shape=(1, 2, 3), highest=1023):
    values = rng.integers(0, highest, (n, frames, *shape)).astype(np.uint16)
    values[0, 0].flat[0] = highest
    return values


def csv_blocks(path, size=2_000_000):
    """The frames of a table, about so many bytes of text at a time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(spans, "PIECE", size)
        for recording in csv_folder.open(path):
            yield from recording.blocks()
