"""The senders of ``examples/esp32``: on a board with a broken crossing, their packets tell it."""

import ctypes
import importlib.util
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import parse_packet
from diagnostics import Scan, SensorLayout, judge_scan
from diagnostics.simulation.circuit import Circuit, StuckCell
from diagnostics.simulation.scan import LOW, scan_circuit

SENDERS = Path(__file__).parents[2] / "examples" / "esp32"
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1")
LAYOUT = SensorLayout(1, 11, 10)
TOP = 4095
OPEN = LAYOUT.cell(0, 3, 4)
SHORT = LAYOUT.cell(0, 8, 1)


class Board:
    """A board whose crossings read what the circuit gives, in counts."""

    def __init__(self):
        faults = (StuckCell(OPEN, np.inf), StuckCell(SHORT, 0.0))
        scan = scan_circuit(Circuit(LAYOUT, faults=faults), np.full(LAYOUT.n_cells, 0.01))
        self.frames = {
            level: iter(np.rint(scan.readings[scan.levels == level] * TOP).astype(int).tolist())
            for level in (0.0, LOW, 1.0)
        }
        self.packets = []
        self.row = None
        self.at = 0
        self.counts = list(range(LAYOUT.n_cells))

    def drive(self, row, level):
        if level is None or level < 0:
            assert row == self.row
            self.row = None
            return
        assert self.row is None  # one row at a time
        self.row = row
        self.level = float(level)

    def read(self, column, is_scan):
        if is_scan and self.row == 0 and column == 0:
            self.counts = next(self.frames[self.level])
        return self.counts[LAYOUT.cell(0, self.row, column)]

    def now(self):
        self.at += 20
        return self.at

    def send(self, packet):
        self.packets.append(bytes(packet))


def micropython(board):
    path = SENDERS / "sender.py"
    spec = importlib.util.spec_from_file_location("sender", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sender = module.Sender(board, "hand", LAYOUT.rows, LAYOUT.cols)
    return sender.frame, sender.scan


class InC(ctypes.Structure):
    """``board`` of sender.c."""

    _fields_ = (
        ("drive", ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_float)),
        ("read", ctypes.CFUNCTYPE(ctypes.c_uint16, ctypes.c_int, ctypes.c_int)),
        ("now", ctypes.CFUNCTYPE(ctypes.c_uint32)),
        ("send", ctypes.CFUNCTYPE(None, ctypes.POINTER(ctypes.c_char), ctypes.c_int)),
    )


def in_c(board, folder):
    if COMPILER is None:
        pytest.skip("no C compiler: install gcc or clang")
    library = folder / "sender.so"
    made = [COMPILER, *FLAGS, "-shared", "-fPIC", SENDERS / "sender.c", "-o", library]
    subprocess.run(made, check=True)
    kinds = dict(InC._fields_)
    given = InC(
        kinds["drive"](board.drive),
        kinds["read"](board.read),
        kinds["now"](board.now),
        kinds["send"](lambda packet, length: board.send(packet[:length])),
    )
    sender = ctypes.CDLL(str(library))
    return (
        lambda: sender.sender_frame(ctypes.byref(given), b"hand"),
        lambda: sender.sender_scan(ctypes.byref(given), b"hand"),
    )


@pytest.mark.parametrize("language", ["C", "MicroPython"])
def test_a_sender_sends_frames_of_version_1_and_scans_that_tell_what_is_broken(language, tmp_path):
    board = Board()
    frame, scan = in_c(board, tmp_path) if language == "C" else micropython(board)
    frame()
    scan()
    first, *others = [parse_packet(packet, LAYOUT.n_cells) for packet in board.packets]
    assert (first.device, first.scan) == ("hand", None)
    assert first.values.tolist() == list(range(LAYOUT.n_cells))
    assert len(others) == 48
    assert max(map(len, board.packets)) <= 1460
    found = judge_scan(Scan.of([(one.scan, one.values) for one in others]), LAYOUT)
    assert {fault.cells for fault in found.faults} == {(OPEN,), (SHORT,)}
    assert found.alive.sum() == LAYOUT.n_cells - 2


def test_both_senders_write_the_same_packets(tmp_path):
    boards = Board(), Board()
    for send in (*in_c(boards[0], tmp_path), *micropython(boards[1])):
        send()
    assert boards[0].packets == boards[1].packets
