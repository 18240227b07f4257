"""The commands that read, convert and simulate recordings, and what all commands do with paths and
layouts."""

import argparse
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adaptfault import __version__
from adaptfault.cli import main
from adaptfault.cli.diagnose import Diagnose
from adaptfault.cli.diagnose import _write as write_results
from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings import load, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.data.summary import summarise
from diagnostics import SelfDiagnosis, SensorLayout

SKIN = SensorLayout(1, 6, 5, full_scale=3.3, unit="V", rate=20)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def skin():
    return simulate(3, SKIN, n_frames=24, seed=2, classes=("nothing", "softer", "harder"))


@pytest.fixture
def file(skin, tmp_path):
    save_npz(tmp_path / "skin.npz", skin)
    return tmp_path / "skin.npz"


def run(capsys, *arguments):
    """Return exit code, stdout and stderr of a command."""
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_info_shows_the_content_as_text_as_json_and_as_a_picture(file, skin, tmp_path, capsys):
    code, text, _ = run(capsys, "info", file, "--picture", tmp_path / "skin.png")
    assert code == 0
    assert "9 of 24 frames each, 11 s in all" in text
    assert "1 x 6 x 5 cells, 0..3.3 V, 20 Hz" in text
    assert "3: nothing 3, softer 3, harder 3" in text
    assert "least step 0.000806" in text
    assert (tmp_path / "skin.png").read_bytes().startswith(b"\x89PNG")
    _, text, _ = run(capsys, "info", file, "--json")
    found = json.loads(text)
    assert found["layout"] == SKIN.to_dict()
    assert found["highest"] == pytest.approx(max(frames.max() for frames in skin))
    assert (found["missing"], found["inferred"], found["recordings"]) == (0, [], 9)


def test_the_pads_of_a_picture_that_do_not_fit_side_by_side_are_below_each_other():
    layout = SensorLayout(5, 1, 12)
    figure = summarise(
        [np.random.default_rng(0).uniform(0, 5, (20, layout.n_cells))], layout
    ).plot()
    assert max(figure.get_size_inches()) < 12
    maps = [ax for ax in figure.axes if "pad" in ax.get_title()]
    assert [ax.get_title() for ax in maps] == [
        f"{what}, pad {pad}" for what in ("mean", "peak") for pad in range(5)
    ]
    figure.draw_without_rendering()
    boxes = [ax.get_window_extent() for ax in maps]
    assert len({round(box.x0) for box in boxes}) == 2
    assert min(box.width for box in boxes) > 2 * figure.dpi


def test_info_names_silent_cells_missing_readings_and_what_was_inferred(skin, tmp_path, capsys):
    frames = np.stack(skin.frames).reshape(9, 24, 6, 5).copy()
    frames[:, :, 2, 3] = 1.5
    frames[0, 5, 1, 1] = np.nan
    np.savez(tmp_path / "raw.npz", frames=frames)
    code, text, _ = run(capsys, "info", tmp_path / "raw.npz")
    assert code == 0
    (silent,) = [line for line in text.splitlines() if line.startswith("silent")]
    assert "of 30 cells never change" in silent
    assert "pad 0, row 2, column 3" in silent
    assert "missing      1 reading\n" in text
    assert (
        "shape 1x6x5 (frames [9, 24, 6, 5] are 9 recordings of one pad); otherwise give --shape"
        in text
    )
    assert "full scale 3.3 a.u. (converter step 0.000806, 12 bits" in text
    assert "rate 10 Hz (assumed: no file states one); otherwise give --rate" in text


@pytest.mark.parametrize("name", ["out.npz", "out.npy", "out.bag", "out"])
def test_recordings_are_converted_and_read_back(name, file, skin, tmp_path, capsys):
    if name == "out.bag":
        pytest.importorskip("rosbags")
    code, _, said = run(capsys, "convert", file, "--out", tmp_path / name)
    assert code == 0
    options = (
        {"layout": "6x5", "full_scale": 3.3, "unit": "V", "rate": 20}
        if name in ("out.npy", "out.bag")
        else {}
    )
    again = load(tmp_path / name, **options)
    assert again.inferred == ()
    assert again.recordings.layout == SKIN
    # folders come in the order of their names
    order = [6, 7, 8, 0, 1, 2, 3, 4, 5] if name == "out" else range(9)
    for one, i in zip(again.recordings, order, strict=True):
        np.testing.assert_array_equal(one, skin.frames[i])
    kept = name in ("out.npz", "out")
    assert (again.recordings.labels is not None) == kept
    assert ("not stored in this format: labels" in said) != kept


def test_a_selection_of_recordings_is_broken_on_the_way(file, skin, tmp_path, capsys):
    broken = tmp_path / "broken.npz"
    assert (
        run(capsys, "convert", file, "--take", "::2", "--inject", "row:0:3=short", "--out", broken)[
            0
        ]
        == 0
    )
    recordings = load(broken).recordings
    assert len(recordings) == 5
    for frames in recordings:
        grid = SKIN.grid(frames)
        assert (grid[:, 0, 3] == np.float32(3.3)).all()
    assert run(capsys, "convert", file, "--leave", "::2", "--out", tmp_path / "rest.npz")[0] == 0
    assert load(tmp_path / "rest.npz").recordings.names == tuple(skin.names[1::2])
    code, _, said = run(capsys, "convert", file, "--take", "often", "--out", tmp_path / "a.npz")
    assert (code, "--take often: expected a Python slice, as 0:100 or ::5" in said) == (3, True)


def test_simulated_grasps_are_written_with_the_layout_of_the_options(tmp_path, capsys):
    out = tmp_path / "grasps.npz"
    options = ["--shape", "6x5", "--full-scale", "3.3", "--unit", "V", "--rate", "20"]
    small = ["--grasps", "2", "--frames", "12", "--classes", "nothing", "harder"]
    assert run(capsys, "simulate", *options, *small, "--out", out)[0] == 0
    loaded = load(out)
    assert loaded.recordings.layout == SKIN
    assert (len(loaded.recordings), loaded.recordings.class_names) == (4, ("nothing", "harder"))
    code, _, said = run(capsys, "simulate", "--grasps", "0", "--out", out)
    assert (code, "n_per_class >= 1" in said) == (3, True)


def test_what_is_inferred_is_printed_once_and_what_is_stated_is_not(tmp_path, capsys):
    values = np.random.default_rng(0).integers(0, 2500, (3, 40, 30)) * (2.5 / 4095)
    for i, frames in enumerate(values):
        np.savetxt(tmp_path / f"{i}.csv", frames, delimiter=",", fmt="%.6f")
    code, _, said = run(capsys, "diagnose", tmp_path, "--shape", "6x5")
    assert code in (0, 1, 2)
    assert said.count("inferred: full scale 2.5 a.u. (converter step 0.00061") == 1
    assert said.count("inferred: rate 10 Hz (assumed") == 1
    options = ["--shape", "6x5", "--full-scale", "2.5", "--unit", "V", "--rate", "10"]
    assert "inferred" not in run(capsys, "diagnose", tmp_path, *options)[2]
    code, _, said = run(capsys, "diagnose", tmp_path)
    assert (
        code,
        "30 values a frame, and nothing states their rows" in said,
        "such as 5x6" in said,
    ) == (3, True, True)


def test_the_log_is_read_in_the_layout_of_its_reference(file, skin, tmp_path, capsys):
    log = tmp_path / "log.npy"
    np.save(log, np.stack(skin.frames).reshape(9, 24, 6, 5))
    code, text, said = run(capsys, "diagnose", log, "--reference", file, "--json")
    assert code in (0, 1, 2)
    assert json.loads(text)["layout"] == SKIN.to_dict()
    assert "inferred" not in said
    np.savez(
        tmp_path / "counts.npz", frames=np.ones((2, 24, 1, 6, 5)), full_scale=4095.0, unit="count"
    )
    code, _, said = run(capsys, "diagnose", tmp_path / "counts.npz", "--reference", file)
    assert (code, "full scale 4095 count where 3.3 V is expected" in said) == (3, True)


def test_diagnose_writes_a_page_with_the_verdict_first(file, tmp_path, capsys):
    broken = tmp_path / "broken.npz"
    run(capsys, "convert", file, "--take", "3:", "--inject", "row:0:3=short", "--out", broken)
    page = tmp_path / "page.html"
    assert run(capsys, "diagnose", broken, "--reference", file, "--html", page)[0] == 2
    html = page.read_text()
    assert ">Call a technician</h1>" in html
    assert html.index("Call a technician") < html.index("row 3 is short") < html.index("Verdicts")
    assert "not tested" in html
    assert "http" not in html.replace("http-equiv", "")
    out = tmp_path / "diagnosis.json"
    diagnose = ("diagnose", broken, "--reference", file, "--count-from", 1)
    text = run(capsys, *diagnose, "--html", page, "--out", out)[1]
    assert "row 4 is short" in text
    assert "row 4 is short" in page.read_text()
    assert "row 3 is short" in out.read_text()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["diagnose", "{file}", "--reference", "gone"], "gone: is not there"),
        (["train", "gone.npz", "--out", "m"], "gone.npz: is not there"),
        (["diagnose", ""], "'': is not there"),  # not the current folder
        (["maintain", "{file}", "{file}", "--report", ""], "expected a bundle"),
        (["diagnose", "{file}", "--html", ""], "--html '': name a file"),
        (["evaluate", "gone", "{file}"], "gone: is not there"),
        (["evaluate", "{file}", "{file}"], "expected a model, a folder with manifest.json"),
        (["maintain", "gone", "{file}"], "gone: expected a bundle"),
        (
            ["diagnose", "{file}", "--out", "gone/d.json"],
            "--out gone/d.json: the folder gone is not there",
        ),
        (
            ["info", "{file}", "--picture", "gone/p.png"],
            "--picture gone/p.png: the folder gone is not there",
        ),
    ],
)
def test_bad_paths_are_refused_before_anything_heavy_is_imported(arguments, expected, file):
    code = (
        "import sys; from adaptfault.cli import main\n"
        f"code = main({[a.format(file=file) for a in arguments]!r})\n"
        "sys.exit(code + 10 * any(m in sys.modules for m in ('torch', 'sklearn', 'numpy')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=False, capture_output=True, text=True
    )
    assert done.returncode == 3
    assert expected in done.stderr


def test_a_cell_that_always_reads_far_outside_the_range_is_a_fault_and_no_other_unit(
    file, skin, tmp_path, capsys
):
    frames = np.zeros((3, 24, 1, 6, 5), np.float32)
    frames[..., 2, 3] = 1e30
    np.savez(
        tmp_path / "idle.npz",
        frames=frames,
        full_scale=skin.layout.full_scale,
        rate=skin.layout.rate,
    )
    code, printed, told = run(capsys, "diagnose", tmp_path / "idle.npz", "--reference", file)
    assert (code, "same unit" in told) == (1, False)
    assert "row 2, column 3" in printed


def test_a_log_of_another_array_is_refused_before_the_reference_is_fitted(
    file, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(SelfDiagnosis, "fit", lambda *args, **options: pytest.fail("fitted"))
    other = tmp_path / "other.npz"
    np.savez(other, frames=np.ones((2, 20, 1, 7, 5), np.uint8))
    code, _, said = run(capsys, "diagnose", other, "--reference", file)
    assert code == 3
    assert (
        "frames of 1 x 7 x 5 (pads x rows x cols) where the layout has 1 x 6 x 5; use recordings of"
        " the same" in said
    )


@pytest.mark.parametrize("shape", ["", "10x", "abc", "2x3x4x5"])
def test_an_option_shape_that_is_none_is_refused_as_a_shape(shape, file, capsys):
    code, _, said = run(capsys, "info", file, "--shape", shape)
    assert (code, said.count("\n")) == (3, 1)
    assert "expected pads x rows x columns, such as 2x13x6" in said


def test_a_simulation_that_would_fill_the_memory_is_refused(tmp_path, capsys):
    code, _, told = run(capsys, "simulate", "--grasps", 10**9, "--out", tmp_path / "s.npz")
    assert (code, "more than 2,147,483,648" in told, len(told.splitlines())) == (3, True, 1)


def test_a_pipe_is_written_to_and_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    atomic_write(tmp_path / "pipe", b"page")
    assert os.read(reader, 10) == b"page"
    os.close(reader)
    assert (tmp_path / "pipe").is_fifo()


def test_a_diagnosis_stays_whole_where_the_disk_is_full(skin, tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    diagnosis = SelfDiagnosis(skin.layout).diagnose(skin.frames[:1])
    arguments = Diagnose.of(argparse.Namespace(out=str(tmp_path / "d.json")))
    write_results(arguments, diagnosis, 0, [])
    before = (tmp_path / "d.json").read_text()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_results(arguments, diagnosis, 0, [])
    assert (tmp_path / "d.json").read_text() == before
    assert [file.name for file in tmp_path.iterdir()] == ["d.json"]


def test_the_version_and_the_help_are_printed_without_a_command(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"adaptfault {__version__}\n"
    assert main([]) == 0
    assert "usage: adaptfault" in capsys.readouterr().out
