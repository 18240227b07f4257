"""The monitor for the microcontroller: the C says what the Python says, and healthy cells are not
told.

``ARRAY`` are 7 x 5 cells that a load of 3 x 3 cells passes over.
"""

import ctypes
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.firmware import CellState, CountingMonitor, Limits, monitor_source
from adaptfault.firmware.counting import MISSING, PREDICTORS, SETTLED, TOP
from adaptfault.firmware.learning import counts_per_unit, from_recordings
from diagnostics import SensorLayout

COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1")
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
ARRAY = SensorLayout(1, 7, 5, full_scale=1000.0, unit="count")
HARNESS = """
#include "monitor.c"

unsigned long size_of_cell(void);
void run(const int16_t *frames, int n, uint8_t *states, uint8_t *frozen);

unsigned long size_of_cell(void) { return sizeof(monitor_cell); }

void run(const int16_t *frames, int n, uint8_t *states, uint8_t *frozen)
{
    static monitor skin;
    monitor_begin(&skin);
    for (int t = 0; t < n; t++) {
        monitor_update(&skin, frames + (long)t * MONITOR_CELLS);
        frozen[t] = (uint8_t)monitor_frozen(&skin);
        for (int i = 0; i < MONITOR_CELLS; i++) {
            states[(long)t * MONITOR_CELLS + i] = (uint8_t)monitor_state(&skin, i);
        }
    }
}
"""

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler: install gcc or clang")


def compiled(source: str, folder: Path) -> ctypes.CDLL:
    (folder / "monitor.c").write_text(source)
    (folder / "harness.c").write_text(HARNESS)
    library = folder / "monitor.so"
    made = [COMPILER, *FLAGS, "-shared", "-fPIC", "harness.c", "-o", library]
    subprocess.run(made, cwd=folder, check=True)
    return ctypes.CDLL(str(library))


def told_in_c(library: ctypes.CDLL, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    counts = np.ascontiguousarray(counts, np.int16)
    states = np.zeros(counts.shape, np.uint8)
    frozen = np.zeros(len(counts), np.uint8)
    pointers = (one.ctypes.data_as(ctypes.c_void_p) for one in (counts, states, frozen))
    given_counts, given_states, given_frozen = pointers
    library.run(given_counts, len(counts), given_states, given_frozen)
    return states, frozen.astype(bool)


def told_in_python(limits: Limits, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    monitor = CountingMonitor(limits)
    states = np.zeros(counts.shape, np.uint8)
    frozen = np.zeros(len(counts), bool)
    for i, frame in enumerate(counts):
        monitor.update(frame)
        states[i] = monitor.states
        frozen[i] = monitor.frozen
    return states, frozen


def passing(layout: SensorLayout, passes: int, seed: int = 0) -> np.ndarray:
    """Return int16 ``[T, D]``: a load that passes over the array again and again, with noise."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(passes):
        row = rng.uniform(0, layout.rows - 1)
        for col in np.arange(-2, layout.cols + 2, 0.5):
            rows, cols = np.indices((layout.rows, layout.cols))
            near = np.maximum(np.abs(rows - row), np.abs(cols - col)) <= 1.5
            frames.append(300 * near.ravel() * rng.uniform(0.5, 1.5) + rng.integers(0, 3))
    return np.rint(frames).astype(np.int16)


def known(layout: SensorLayout, dither: int, near: int) -> Limits:
    cells = layout.n_cells
    return Limits(
        per_unit=1.0,
        dither=dither,
        near=near,
        patience=40,
        silent_after=32,
        rest=np.zeros(cells, np.int16),
        lowest=np.full(cells, -TOP, np.int16),
        highest=np.full(cells, TOP, np.int16),
        stuck_after=np.zeros(cells, np.uint16),
        predictors=np.zeros((cells, PREDICTORS), np.uint16),
    )


@pytest.fixture(scope="module")
def limits() -> Limits:
    living = ARRAY.present.ravel()
    return from_recordings(known(ARRAY, 10, 20), [passing(ARRAY, 150)], ARRAY, living)


@pytest.fixture(scope="module")
def hasty() -> Limits:
    """Limits of six cells that any few frames reach."""
    layout = SensorLayout(1, 2, 3)
    few = known(layout, 2, 1)
    predictors = np.array([[1, 2, 3, 4], [0, 2, 3, 5], [1, 0, 5, 4], [0, 0, 1, 2]] * 2, np.uint16)
    return Limits(
        **{
            **vars(few),
            "patience": 2,
            "silent_after": 2,
            "lowest": np.array([-3, -2, 0, -9, -9, -9], np.int16),
            "highest": np.array([3, 9, 9, 2, 9, 9], np.int16),
            "stuck_after": np.array([1, 2, 3, 0, 1, 5], np.uint16),
            "predictors": predictors[:6],
        }
    )


@pytest.fixture(scope="module")
def library(limits: Limits, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return compiled(monitor_source(limits, ARRAY), tmp_path_factory.mktemp("monitor"))


@pytest.fixture(scope="module")
def hasty_library(hasty: Limits, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    source = monitor_source(hasty, SensorLayout(1, 2, 3))
    return compiled(source, tmp_path_factory.mktemp("hasty"))


counts = st.one_of(st.integers(-5, 5), st.sampled_from([MISSING, -TOP, TOP]))
frame = st.lists(counts, min_size=6, max_size=6)
# each again and again, so that runs become long and frames repeat
streams = st.lists(st.tuples(frame, st.integers(1, 6)), min_size=1, max_size=40)


@needs_compiler
@given(streams)
def test_the_c_says_of_any_stream_what_the_python_says(hasty, hasty_library, stream):
    frames = np.array([one for one, times in stream for _ in range(times)], np.int16)
    for c, python in zip(
        told_in_c(hasty_library, frames), told_in_python(hasty, frames), strict=True
    ):
        assert np.array_equal(c, python)


@needs_compiler
@pytest.mark.slow
def test_it_does_so_where_runs_are_longer_than_its_counters_hold(hasty, hasty_library):
    frames = np.zeros((140_000, 6), np.int16)
    frames[::2, 0] = 1  # no frame repeats the one before it
    frames[:, 1] = MISSING
    for c, python in zip(
        told_in_c(hasty_library, frames[-70_000:]),
        told_in_python(hasty, frames[-70_000:]),
        strict=True,
    ):
        assert np.array_equal(c, python)


@needs_compiler
def test_a_cell_takes_12_bytes(library):
    assert library.size_of_cell() == 12


@needs_compiler
@pytest.mark.parametrize("name", ["hand3x13x6_grasps51", "insole2x33x15", "icub5x1x12_grasps11"])
def test_the_c_says_of_real_recordings_what_the_python_says(name, tmp_path):
    path = DATA / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"no recordings of {name} here")
    from adaptfault.data.recordings import load

    recordings = load(path).recordings
    layout = recordings.layout
    frames = np.concatenate(recordings.frames)[:3000].astype(np.int16)
    top = int(frames.max())
    start = known(layout, max(1, top // 100), max(1, top // 50))
    start = Limits(**{**vars(start), "rest": np.median(frames, axis=0).astype(np.int16)})
    learned = from_recordings(start, [frames[:1500]], layout, layout.present.ravel())
    broken = frames.copy()
    broken[500:, ::7] = broken[500, ::7]
    broken[900:, ::11] = MISSING
    library = compiled(monitor_source(learned, layout), tmp_path)
    states, frozen = told_in_c(library, broken)
    expected, expected_frozen = told_in_python(learned, broken)
    assert np.array_equal(states, expected)
    assert np.array_equal(frozen, expected_frozen)


def test_a_cell_that_holds_a_value_while_its_predictors_move_is_stuck_and_no_healthy_one(limits):
    frames = passing(ARRAY, 150, seed=1)
    healthy, _ = told_in_python(limits, frames)
    assert not healthy.any()
    dead = ARRAY.cell(0, 3, 2)
    for value in (0, 120, 450):
        frames[:, dead] = value
        told, _ = told_in_python(limits, frames)
        assert told[-1, dead] == CellState.STUCK
        assert not np.delete(told, dead, axis=1).any()


def test_a_cut_row_is_stuck_as_predictors_are_not_all_on_it(limits):
    frames = passing(ARRAY, 300, seed=1)
    row = ARRAY.cell(0, 3, 0) + np.arange(ARRAY.cols)
    frames[:, row] = 0
    told, _ = told_in_python(limits, frames)
    assert (told[-1, row] == CellState.STUCK).all()
    assert not np.delete(told, row, axis=1).any()


def test_silent_outside_and_frozen_are_told(limits):
    frames = passing(ARRAY, 10, seed=2)
    frames[:, 3] = MISSING
    frames[:, 9] = int(limits.highest[9]) + 1
    told, frozen = told_in_python(limits, frames)
    assert told[-1, 3] == CellState.SILENT
    assert told[SETTLED + 1, 9] == CellState.OUTSIDE
    assert not frozen.any()
    held = np.repeat(frames[5:6], 60, axis=0)
    _, frozen = told_in_python(limits, np.concatenate([frames, held]))
    assert frozen[-1]


def test_an_untouched_skin_tells_nothing_however_long_it_rests(limits):
    frames = np.zeros((3000, ARRAY.n_cells), np.int16)
    told, frozen = told_in_python(limits, frames)
    assert not told.any()
    assert not frozen.any()


def test_missing_and_infinite_readings_are_missing_counts(limits):
    counts = limits.counts(np.array([np.nan, np.inf, -np.inf, 2.4, 1e9, -1e9]))
    assert counts.tolist() == [MISSING, MISSING, MISSING, 2, TOP, -TOP]


@given(st.floats(0, 1e3), st.floats(0.01, 1e5))
def test_twice_full_scale_fits_the_counts_whatever_the_step(step, full_scale):
    layout = SensorLayout(1, 2, 2, full_scale=full_scale)
    assert 2 * full_scale * counts_per_unit(layout, step) <= TOP * (1 + 1e-9)


def test_a_unit_cannot_end_the_comment_of_the_file(hasty):
    layout = SensorLayout(1, 2, 3, unit="N*/ int main")
    source = monitor_source(hasty, layout)
    assert source.split("#ifndef")[0].count("*/") == 1


@needs_compiler
def test_the_command_writes_a_monitor_that_compiles(bundle, tmp_path, capsys):
    out = tmp_path / "monitor.c"
    assert main(["export-monitor", str(bundle.path), "--out", str(out), "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert about["bytes"] == 12 * bundle.layout.n_cells + 2
    assert about["judged"] > 0.5 * about["cells"]
    subprocess.run(
        [COMPILER, *FLAGS, "-c", out, "-o", tmp_path / "monitor.o"], check=True, cwd=tmp_path
    )


def test_recordings_of_another_array_are_refused_in_one_line(bundle, tmp_path, capsys):
    np.savez(tmp_path / "other.npz", frames=np.eye(9, dtype=int).reshape(1, 9, 1, 3, 3))
    out = str(tmp_path / "monitor.c")
    arguments = ["export-monitor", str(bundle.path), "--out", out]
    assert main([*arguments, "--reference", str(tmp_path / "other.npz")]) == 3
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "give fault-free recordings of this array" in error
