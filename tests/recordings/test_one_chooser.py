"""The same table in several formats: the same readings, times, episodes, classes and shape."""

import csv
import json

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import load
from diagnostics.decision.numbering import Numbering

rng = np.random.default_rng(0)

CELLS = {
    "grid": [f"tactile_{i}_{j}" for i in range(3) for j in range(4)],
    "pads": [f"{side}_ch{i}" for side in "RL" for i in range(6)],
    "plain": [f"c{i}" for i in range(12)],
}
SHAPES = {"grid": (1, 3, 4), "pads": (2, 1, 6), "plain": None}


def written(path, columns):
    """Write a table, a column a name, in the format of the file's name."""
    if path.suffix == ".parquet":
        pa = pytest.importorskip("pyarrow")
        pytest.importorskip("pyarrow.parquet").write_table(pa.table(columns), path)
    elif path.suffix == ".csv":
        rows = zip(*columns.values(), strict=True)
        lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
        path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("cells", CELLS)
@pytest.mark.parametrize("extra", [(), ("flags",), ("packet_size", "max_value")])
def test_a_table_is_read_the_same_whatever_its_format(tmp_path, suffix, cells, extra):
    episodes = np.repeat(np.arange(4), 25)
    readings = rng.random((100, 12)).round(3)
    columns = {"episode_index": episodes, "timestamp": np.tile(np.arange(25) / 50, 4)}
    columns |= dict.fromkeys(extra, np.arange(100) % 7)
    columns |= dict(zip(CELLS[cells], readings.T, strict=True))
    columns["task"] = np.repeat(["a", "b", "a", "b"], 25).tolist()
    path = written(tmp_path / f"t{suffix}", columns)
    loaded = load(path, shape=None if SHAPES[cells] else "3x4")
    recordings = loaded.recordings
    assert recordings.layout.shape == (SHAPES[cells] or (1, 3, 4))
    assert recordings.layout.rate == 50
    assert recordings.labels.tolist() == [0, 1, 0, 1]
    assert [name.rpartition(", ")[2] for name in recordings.names] == [
        f"episode {i}" for i in range(4)
    ]
    np.testing.assert_array_equal(np.concatenate(recordings.frames), readings.astype(np.float32))
    assert any("left out, as no reading" in text for text in loaded.inferred) == bool(extra)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".jsonl", ".h5"])
@pytest.mark.parametrize("hold", [25, 1])
def test_a_class_that_changes_divides_a_file_or_is_told_in_every_format(tmp_path, suffix, hold):
    labels = np.tile(np.repeat(["sit", "lean", "sit"], hold), 75 // hold)[:150].tolist()
    readings = rng.random((150, 4)).round(3)
    path = tmp_path / f"t{suffix}"
    if suffix == ".jsonl":
        each = zip(readings.tolist(), labels, strict=True)
        path.write_text("".join(json.dumps({"touch": x, "label": y}) + "\n" for x, y in each))
    elif suffix == ".h5":
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["touch"] = readings
            file["label"] = labels
    else:
        columns = {f"touch_{i}": column for i, column in enumerate(readings.T)}
        written(path, columns | {"label": labels})
    loaded = load(path, shape="2x2")
    warnings = [problem.message for problem in loaded.problems]
    if hold == 1:
        assert len(loaded.recordings) == 1
        assert any("the class changes" in text and "is lost" in text for text in warnings)
    else:
        found = [loaded.recordings.class_names[i] for i in loaded.recordings.labels]
        assert found == ["sit", "lean", "sit", "lean", "sit"][: len(found)] or len(found) == 5
        assert any("a recording begins where the class changes" in t for t in loaded.inferred)
    np.testing.assert_array_equal(
        np.concatenate(loaded.recordings.frames), readings.astype(np.float32)
    )


@pytest.fixture
def soles(tmp_path):
    """Two soles of 8 channels, each with its own contacts; R_ch2 reads 0.9 throughout."""
    time = np.arange(600)[:, None]
    readings = np.clip(np.sin(time / rng.uniform(5, 9, 16) + rng.uniform(0, 6, 16)), 0, 1)
    readings = (readings * 0.8 + rng.normal(0, 0.003, readings.shape)).round(4)
    readings[:, 10] = 0.9
    names = [f"{side}_ch{i}" for side in "LR" for i in range(8)]
    return written(tmp_path / "soles.csv", dict(zip(names, readings.T, strict=True)))


def test_a_cell_is_called_as_its_column_is(soles, tmp_path, capsys):
    layout = load(soles, shape="2x2x4").recordings.layout
    assert layout.place(10) == "pad 1, row 0, column 2 (R_ch2)"
    assert layout == load(soles, shape="2x2x4", columns="0-15").recordings.layout
    assert "pad 1, row 0, column 2 (R_ch2)" in str(main_out(capsys, "info", soles))
    out = tmp_path / "out.json"
    said = main_out(capsys, "diagnose", soles, "--count-from", "1", "--out", out)
    assert "pad 2, row 1, column 3 (R_ch2)" in said
    told = json.loads(out.read_text())
    assert any("(R_ch2)" in fault["reason"] for fault in told["faults"])
    assert told["layout"]["names"][10] == "R_ch2"


def main_out(capsys, command, path, *options):
    """Return what a command says of recordings of two pads of 2 x 4 cells."""
    main([command, str(path), "--shape", "2x2x4", *map(str, options)])
    return capsys.readouterr().out


@pytest.mark.parametrize("name", ["cell 3", "row 7", "\x1b[2J", "<b>", "a,b" * 40])
def test_a_name_stays_as_it_is_written_and_can_be_printed(tmp_path, name):
    names = [name, "b", "c", "d"]
    path = tmp_path / "a.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *rng.random((20, 4)).round(3).tolist()])
    layout = load(path, shape="2x2").recordings.layout
    shown = layout.names[0]
    assert shown.isprintable()
    assert len(shown) <= 40
    told = Numbering.from_layout(layout, 1).text(f"{layout.place(0)} is open")
    assert told == f"pad 1, row 1, column 1 ({shown}) is open"
