"""Commands that train, score, repair and run a regression: --targets."""

import json
import shutil

import numpy as np
import pytest
from conftest import SIMULATED, VALUES, forces, without_export, write_forces

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.models.network import logits_of
from adaptfault.models.store import load_model


@pytest.fixture
def home(forces_home, tmp_path, monkeypatch):
    """The folder of the recordings is the working folder."""
    for name in ("grasps", "targets.csv", "model"):
        source = forces_home / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def said(capsys, *command: str, code: int = 0) -> str:
    assert main([*command, "--quiet"]) == code
    given = capsys.readouterr()
    return given.out if code == 0 else given.err


def refused(capsys, *command: str) -> str:
    return said(capsys, *command, code=3)


TRAIN = ("train", "grasps", "--out", "new", "--epochs", "1", "--targets")


def test_training_prints_r2_and_the_error_of_each_value_by_name_and_stores_units(home, capsys):
    out = said(capsys, *TRAIN, "targets.csv", "--learning-rate", "1e-3")
    first, second, *_ = out.splitlines()
    assert first.startswith("test: R2 ")
    assert all(f"{name} " in first for name in VALUES)
    assert "validation R2" in second
    stored = json.loads((home / "new" / "manifest.json").read_text())
    assert stored["task"] == "regression"
    assert tuple(stored["class_names"]) == VALUES
    units = stored["extra"]["units"]
    assert units["force"]["deviation"] > 1000 > 1e-4 > units["column"]["deviation"]
    assert (home / "new" / "training.png").stat().st_size > 10_000


def test_values_of_4000_and_of_0_001_are_learned(home, capsys):
    scores = json.loads(
        said(capsys, "evaluate", "model", "grasps", "--targets", "targets.csv", "--json")
    )
    assert scores["value_names"] == list(VALUES)
    assert scores["scores"]["r2"] > 0.7
    assert scores["r2_interval"][0] < scores["scores"]["r2"] < scores["r2_interval"][1] <= 1
    model = load_model("model")
    x = np.random.default_rng(0).random((4, 10, 60), np.float32)
    np.testing.assert_array_equal(logits_of(model, x), logits_of(load_model("model"), x))


def test_evaluate_takes_faults_the_columns_in_any_order_and_others_beside_them(home, capsys):
    whole = said(capsys, "evaluate", "model", "grasps", "--targets", "targets.csv")
    assert whole.startswith("R2 ")
    assert "95 % interval of R2" in whole
    rows = [line.split(",") for line in (home / "targets.csv").read_text().splitlines()]
    (home / "other.csv").write_text(
        "\n".join(
            f"{file},{frame},{column},{force},{'note' if file == 'file' else 7},{row}"
            for file, frame, force, row, column in rows
        )
    )
    assert said(capsys, "evaluate", "model", "grasps", "--targets", "other.csv") == whole
    broken = said(
        capsys,
        *("evaluate", "model", "grasps", "--targets", "targets.csv", "--inject", "row:0:2=short"),
    )
    assert broken.startswith("5 cells faulty: R2 ")


def test_adapt_repairs_a_regression_and_keeps_its_adapter(home, capsys):
    faults = ("--faults", "10,11,12,13,14")
    out = said(
        capsys,
        *("adapt", "model", "grasps", "--targets", "targets.csv", *faults),
        *("--forecast", "--out", "adapted", "--keep", "kept"),
    )
    assert "expected R2 without 5 cells" in out
    assert "validation, fault-free: R2 " in out
    assert "accuracy" not in out
    again = said(capsys, "adapt", "kept", *faults, "--out", "again")
    assert "validation, 5 cells removed: R2 " in again
    injected = ("--inject", "row:0:2=short", "--targets", "targets.csv", "--json")
    reached = [
        json.loads(said(capsys, "evaluate", "model", "grasps", *injected, *adapted))["scores"]["r2"]
        for adapted in ((), ("--adapted", "adapted"))
    ]
    assert reached[1] > reached[0] + 0.2
    assert "R2" in said(capsys, "forecast", "kept", *faults)


def test_predict_prints_the_values_of_each_recording_by_name(
    home, forces_bundle, later_grasps, capsys
):
    recordings = Recordings((*later_grasps[:3], later_grasps[0][:4]), SIMULATED)
    save_npz(home / "today.npz", recordings)
    for which in (("--model", "model"), ("--bundle", str(forces_bundle.path))):
        head, *rows = said(capsys, "predict", "today.npz", *which).splitlines()
        assert head.split() == ["recording", *VALUES, "windows"]
        assert len(rows) == 4
        assert "shorter than a window" in rows[3]
        given = json.loads(said(capsys, "predict", "today.npz", *which, "--json"))
        assert given["value_names"] == list(VALUES)
        *whole, short = given["predictions"]
        assert (short["values"], short["windows"], short["each"]) == (None, 0, [])
        for one in whole:
            np.testing.assert_allclose(np.mean(one["each"], axis=0), one["values"], rtol=1e-5)
    true = np.stack([forces(frames)[9::10].mean(0) for frames in later_grasps[:3]])
    found = np.array([one["values"] for one in whole])
    np.testing.assert_allclose(found[:, 0], true[:, 0], rtol=0.5)


def test_targets_and_models_that_do_not_belong_together_are_refused(home, made_bundle, capsys):
    message = refused(capsys, "evaluate", "model", "grasps")
    assert "the model is a regression of force, row, column: give --targets TABLE" in message
    message = refused(capsys, "evaluate", str(made_bundle), "grasps", "--targets", "targets.csv")
    assert "this model names classes: give --labels TABLE" in message
    table = (home / "targets.csv").read_text()
    (home / "lacking.csv").write_text(table.replace("force,row,column", "force,line,column"))
    message = refused(capsys, "evaluate", "model", "grasps", "--targets", "lacking.csv")
    assert (
        "the columns are force, line, column, the model has force, row, column; add row" in message
    )
    message = refused(capsys, *TRAIN, "targets.csv", "--labels", "targets.csv")
    assert "a model learns classes or values, not both" in message
    assert "gone.csv: is not there" in refused(capsys, *TRAIN, "gone.csv")


def test_a_value_that_is_always_the_same_is_refused_by_name(home, capsys):
    lines = ["file,force,weight"]
    lines += [
        f"grasps/{path.name},{i},3" for i, path in enumerate(sorted(home.glob("grasps/*.csv")))
    ]
    (home / "same.csv").write_text("\n".join(lines))
    message = refused(capsys, *TRAIN, "same.csv")
    assert "same.csv: weight is 3 in all training recordings" in message
    assert "leave the column out" in message


def test_a_file_without_targets_is_left_out_and_the_exit_code_says_so(tmp_path, capsys, rng):
    write_forces(tmp_path, [rng.uniform(0, 2, (20, 60)) for _ in range(12)])
    table = tmp_path / "targets.csv"
    kept = [line for line in table.read_text().splitlines() if "/00.csv" not in line]
    table.write_text("\n".join(kept))
    command = ["train", str(tmp_path / "grasps"), "--targets", str(table), "--epochs", "1"]
    assert main([*command, "--out", str(tmp_path / "model"), "--quiet"]) == 1
    given = capsys.readouterr()
    assert "00.csv: is not in the table" in given.err
    assert "add a line for it" in given.err
    assert "1 file or recording was left out" in given.err


def test_repairable_and_linear_training_take_values_too(home, capsys):
    out = said(capsys, *TRAIN, "targets.csv", "--repairable", "--head", "linear")
    assert out.startswith("test: R2 ")


def test_a_model_of_your_own_needs_a_last_linear_layer(home, capsys, monkeypatch):
    (home / "own_values.py").write_text(
        "from torch import nn\n"
        "def good(layout, n, length):\n"
        "    return nn.Sequential(nn.Flatten(), nn.Linear(length * layout.n_cells, n))\n"
        "def positive(layout, n, length):\n"
        "    return nn.Sequential(*good(layout, n, length), nn.Softplus())\n"
        "def more(layout, n, length):\n"
        "    return good(layout, n + 1, length)\n"
    )
    monkeypatch.syspath_prepend(home)
    out = said(capsys, *TRAIN, "targets.csv", "--model", "own_values:good")
    assert out.startswith("test: R2 ")
    message = refused(capsys, *TRAIN, "targets.csv", "--model", "own_values:positive")
    assert "does not end with a nn.Linear with a bias" in message
    message = refused(capsys, *TRAIN, "targets.csv", "--model", "own_values:more")
    assert "has 4 outputs, the recordings have 3 values" in message


def test_maintain_and_report_of_a_regression_print_r2(
    home, forces_bundle, later_grasps, broken_row, capsys
):
    from diagnostics import inject

    log = tuple(inject(r, [broken_row], SIMULATED) for r in later_grasps)
    save_npz(home / "today.npz", Recordings(log, SIMULATED))
    with without_export():
        code = main(["maintain", str(forces_bundle.path), "today.npz", "--quiet"])
    out = capsys.readouterr().out
    assert code in (1, 2)
    assert "R2" in out
    assert "accuracy" not in out
