"""Recordings: where frames come from and what belongs to them."""

from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.layout_file import parse_shape, read_layout
from adaptfault.data.recordings.load import Loaded, load
from adaptfault.data.recordings.npz import save_npz

__all__ = ["InputError", "Loaded", "Problem", "Recordings", "load", "parse_shape", "read_layout", "save_npz"]
