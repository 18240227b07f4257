"""Who waits is told how long, and what to do after an interruption."""

import argparse
import re

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.cli.train import Train, _epoch_line
from adaptfault.data.windows import Windows
from adaptfault.models.history import History


@pytest.fixture
def grasps_file(tmp_path):
    """Three classes on a small array."""
    rng = np.random.default_rng(0)
    labels = np.arange(30) % 3
    frames = rng.uniform(0, 0.2, (30, 20, 1, 3, 3))
    for frame, label in zip(frames, labels, strict=True):
        frame[:, 0, label] += 0.7
    path = tmp_path / "grasps.npz"
    np.savez(path, frames=frames, labels=labels, full_scale=1.0, unit="V", rate=10.0)
    return path


def test_without_a_terminal_each_epoch_is_a_line_with_the_time_left(grasps_file, tmp_path, capsys):
    command = ["train", str(grasps_file), "--epochs", "3", "--out", str(tmp_path / "model")]
    assert main(command) == 0
    told = capsys.readouterr().err
    lines = re.findall(r"epoch (\d) of 3: validation accuracy [01]\.\d+", told)
    assert len(lines) == 3
    assert re.search(r"guessing reaches 0\.[34]", told)
    assert re.search(r"epoch 3 of 3: .*about 0 s left", told)


def test_quiet_tells_no_epoch(grasps_file, tmp_path, capsys):
    command = ["train", str(grasps_file), "--epochs", "2", "--out", str(tmp_path / "model")]
    assert main([*command, "--quiet"]) == 0
    assert "epoch 1 of 2:" not in capsys.readouterr().err


@pytest.mark.parametrize(("command", "continues"), [("train", True), ("info", False)])
def test_after_an_interruption_it_says_whether_the_same_command_continues(
    command, continues, grasps_file, tmp_path, capsys, monkeypatch
):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"adaptfault.cli.{command}.{command.title()}.run", interrupted)
    out = ["--out", str(tmp_path / "model")] if command == "train" else []
    assert main([command, str(grasps_file), *out]) == 130
    told = capsys.readouterr().err
    assert ("run the same command to continue" in told) is continues


@pytest.mark.parametrize("of_values", [True, False])
def test_a_training_at_chance_after_three_epochs_is_told_and_one_of_values_never_is(
    of_values, capsys
):
    args = Train.of(argparse.Namespace(quiet=False, epochs=5))
    y = np.arange(30) % 3
    windows = Windows(np.zeros((30, 2, 4), np.float32), y, np.arange(30))
    units = object() if of_values else None
    told = _epoch_line(args, windows, units)
    told(History((1.0,) * 3, (1.0,) * 3, (-0.2, -0.1, 0.0), (1.0,) * 3, best_epoch=3))
    assert ("at chance after 3 epochs" in capsys.readouterr().err) == (not of_values)
