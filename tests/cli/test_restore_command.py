import json

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import load, save_npz


def test_recordings_are_restored_with_the_healthy_windows_of_a_bundle(
    made_bundle, small_grasps, tmp_path, capsys
):
    cells = [8, 14, 40]
    broken = small_grasps.select(range(0, 90, 9))
    for frames in broken.frames:
        frames[:, cells] = 5.0
    broken.frames[0][3, 20] = np.nan
    save_npz(tmp_path / "today.npz", broken)
    out = tmp_path / "restored"
    arguments = [
        "--bundle",
        str(made_bundle),
        "--out",
        str(out),
        "--faults",
        "8,14,40",
        "--json",
        "--quiet",
    ]
    assert main(["restore", str(tmp_path / "today.npz"), *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["fault_set"] == cells
    assert result["missing_readings"] == 1
    assert {
        cell: deviation > 0 for cell, deviation in result["deviation"].items()
    } == dict.fromkeys(map(str, cells), True)
    assert json.loads((out / "restored.json").read_text()) == result
    restored = load(out / "restored.npz").recordings
    truth = small_grasps.select(range(0, 90, 9))
    healthy = np.setdiff1d(np.arange(truth.layout.n_cells), [*cells, 20])
    error = total = 0.0
    for new, old in zip(restored.frames, truth.frames, strict=True):
        np.testing.assert_array_equal(new[:, healthy], old[:, healthy])
        error += ((new - old)[:, cells] ** 2).sum()
        total += ((5.0 - old[:, cells]) ** 2).sum()
    assert error < 0.05 * total


def test_a_bundle_without_known_faults_restores_missing_readings_only(
    made_bundle, small_grasps, tmp_path, capsys
):
    one = small_grasps.select([0])
    save_npz(tmp_path / "today.npz", one)
    assert (
        main(
            [
                "restore",
                str(tmp_path / "today.npz"),
                "--bundle",
                str(made_bundle),
                "--out",
                str(tmp_path),
            ]
        )
        == 0
    )
    assert "1 recordings: 0 cells and 0 other missing readings restored" in capsys.readouterr().out
    np.testing.assert_array_equal(
        load(tmp_path / "restored.npz").recordings.frames[0], one.frames[0]
    )


@pytest.mark.parametrize("faults", ["8,600", "no.json"])
def test_faults_that_cannot_be_read_are_one_line_and_exit_code_3(
    faults, made_bundle, small_grasps, tmp_path, capsys
):
    save_npz(tmp_path / "today.npz", small_grasps.select([0]))
    command = [
        "restore",
        str(tmp_path / "today.npz"),
        "--bundle",
        str(made_bundle),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--faults", faults]) == 3
    assert capsys.readouterr().err.count("\n") == 1
