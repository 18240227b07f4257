"""Reads and writes recordings: frames with their layout, labels and names."""

from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.layout_file import parse_shape, read_layout
from adaptfault.data.recordings.load import Loaded, load
from adaptfault.data.recordings.npz import save_npz
from adaptfault.data.recordings.save import save

__all__ = ["InputError", "Loaded", "Problem", "Recordings", "load", "parse_shape", "read_layout", "save", "save_npz"]
