"""Recordings: where frames come from and what belongs to them."""

from adaptfault.recordings.dataset import Recordings
from adaptfault.recordings.errors import InputError, Problem
from adaptfault.recordings.layout_file import parse_shape, read_layout
from adaptfault.recordings.load import Loaded, load
from adaptfault.recordings.npz import save_npz

__all__ = ["InputError", "Loaded", "Problem", "Recordings", "load", "parse_shape", "read_layout", "save_npz"]
