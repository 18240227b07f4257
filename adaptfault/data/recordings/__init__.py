"""Reads and writes recordings: frames with their layout, labels and names."""

from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.layout_file import parse_shape, read_layout
from adaptfault.data.recordings.formats.npz import save_npz
from adaptfault.data.recordings.load import Loaded, load, local_paths, open_recordings
from adaptfault.data.recordings.opened import Opened
from adaptfault.data.recordings.recording import Block, Facts, Recording
from adaptfault.data.recordings.save import save

__all__ = [
    "Block",
    "Facts",
    "InputError",
    "Loaded",
    "Opened",
    "Problem",
    "Recording",
    "Recordings",
    "load",
    "local_paths",
    "open_recordings",
    "parse_shape",
    "read_layout",
    "save",
    "save_npz",
]
