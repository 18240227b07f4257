"""The routines end to end, through the command line."""

import argparse
import json
import logging
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import worn

from adaptfault.cli import BUILT_IN, main, parser_of
from adaptfault.cli.streams import LogAboveBars
from adaptfault.data.recordings import Opened, Recordings, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.data.windows import make_windows
from adaptfault.models.network import TactileTransformer
from adaptfault.models.training import train
from diagnostics import Diagnosis, FaultSet, Line, SelfDiagnosis, SensorLayout, inject, line_fault

SMALL = SensorLayout(2, 6, 5)


@pytest.fixture(scope="module")
def small() -> Recordings:
    return simulate(16, SMALL, n_frames=60, seed=1, classes=("nothing", "softer", "harder"))


@pytest.fixture(scope="module")
def home(small: Recordings, made_once, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings, and a model trained on them by the command line."""

    def make(home: Path) -> None:
        save_npz(home / "grasps.npz", small)
        command = [
            "train",
            str(home / "grasps.npz"),
            "--out",
            str(home / "model"),
            "--epochs",
            "6",
            "--quiet",
        ]
        assert main(command) == 0

    return shutil.copytree(made_once("home", make), tmp_path_factory.mktemp("home") / "home")


def write_csv(path: Path, frames: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, frames, delimiter=",", fmt="%.4f")


def test_a_broken_row_is_diagnosed_adapted_to_and_the_repair_measured(home, small, capsys):
    broken = line_fault(SMALL, Line(1, "row", 2), "short")
    log = small.select([i for i in range(len(small)) if small.labels[i] > 0][:12])
    frames = tuple(inject(r, [broken], SMALL) for r in log.frames)
    save_npz(home / "log.npz", Recordings(frames, SMALL))
    grasps, model, diagnosis = (
        str(home / name) for name in ("grasps.npz", "model", "diagnosis.json")
    )

    picture = str(home / "map.png")
    found = [
        "diagnose",
        str(home / "log.npz"),
        "--reference",
        grasps,
        "--out",
        diagnosis,
        "--picture",
        picture,
    ]
    assert main([*found, "--quiet"]) == 2
    assert "pad 1, row 2 is short" in capsys.readouterr().out
    assert Diagnosis.from_dict(json.loads(Path(diagnosis).read_text())).fault_set == set(
        broken.cells
    )
    assert Path(picture).read_bytes().startswith(b"\x89PNG")

    adapted = str(home / "adapted")
    assert (
        main(["adapt", model, grasps, "--faults", diagnosis, "--out", adapted, "--quiet", "--json"])
        == 0
    )
    adaptation = json.loads(capsys.readouterr().out)
    assert adaptation["fault_set"] == list(broken.cells)

    accuracy = {}
    for name, extra in {
        "healthy": [],
        "broken": ["--inject", "row:1:2=short"],
        "repaired": ["--inject", "row:1:2=short", "--adapted", adapted],
    }.items():
        assert main(["evaluate", model, grasps, "--json", *extra]) == 0
        accuracy[name] = json.loads(capsys.readouterr().out)["scores"]["accuracy"]
    assert accuracy["healthy"] > 0.6
    assert accuracy["broken"] < accuracy["healthy"] - 0.15
    assert accuracy["repaired"] > accuracy["healthy"] - 0.1


@pytest.mark.slow
def test_the_demo_runs_on_the_users_recordings_and_writes_a_report_that_needs_nothing_else(
    home, capsys
):
    out = home / "demo"
    run = [
        "demo",
        "--recordings",
        str(home / "grasps.npz"),
        "--epochs",
        "3",
        "--out",
        str(out),
        "--quiet",
    ]
    assert main(run) == 0
    printed = capsys.readouterr().out
    for step in (
        "recordings",
        "training",
        "fault-free",
        "broken",
        "diagnosis",
        "adaptation",
        "repaired",
        "report",
    ):
        assert re.search(rf"^{step}", printed, re.MULTILINE), step
    html = (out / "report.html").read_text()
    assert html.count('src="data:image/png;base64,') == 2
    assert not re.search(r"(src|href)=.?(http|//|file)", html)
    result = json.loads((out / "result.json").read_text())
    assert f"{100 * result['repaired']['accuracy']:.1f}%" in html
    assert sum(len(f["cells"]) for f in result["injected"]) == SMALL.cols + 3
    assert {f["kind"] for f in result["injected"]} == {"open", "short", "stuck"}
    assert not (out / "training.safetensors").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("fitted_anew")
def test_training_again_gives_the_same_model(home, tmp_path):
    for name in ("first", "again"):
        command = [
            "train",
            str(home / "grasps.npz"),
            "--out",
            str(tmp_path / name),
            "--epochs",
            "2",
            "--quiet",
        ]
        assert main(command) == 0
    weights = [
        next(folder.glob("*.safetensors")).name
        for folder in (tmp_path / "first", tmp_path / "again")
    ]
    assert weights[0] == weights[1]  # named by their hash


def test_recordings_shorter_than_a_window_are_told(home, small, tmp_path, capsys):
    frames = (small.frames[0][:5], small.frames[1][:9], *small.frames[2:])
    save_npz(tmp_path / "log.npz", Recordings(frames, SMALL, small.labels, small.class_names))
    assert main(["evaluate", str(home / "model"), str(tmp_path / "log.npz"), "--all"]) == 0
    assert (
        "2 of 48 recordings are shorter than a window of 10 frames: not used"
        in capsys.readouterr().err
    )


def test_a_crash_of_a_command_is_no_verdict(home, capsys, monkeypatch):
    def crash(args):
        raise RuntimeError("a bug")

    monkeypatch.setattr("adaptfault.cli.info.Info.run", crash)
    assert main(["info", str(home / "grasps.npz")]) == 3  # 1 would be "degraded but handled"
    said = capsys.readouterr().err
    assert "RuntimeError: a bug" in said
    assert said.splitlines()[-1].startswith("adaptfault info: internal error")


# Bad input: one line that names what is wrong, exit code 3, never a traceback


def errors_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(a) for a in arguments]) == 3
    said = capsys.readouterr()
    assert said.out == ""
    assert "Traceback" not in said.err
    lines = [line for line in said.err.splitlines() if line.startswith("adaptfault")]
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: "\n".join(line.rpartition(",")[0] for line in text.splitlines()), "59"),
        (
            lambda text: text.replace("\n", "\nabc,", 1).replace("abc,0.0000,", "abc,", 1),
            "line 2.*abc",
        ),
        (lambda text: "", "empty"),
        (lambda text: text.replace("\n", ",1\n", 1), "line 1|line 2"),
        (lambda text: "\x00\x01\x02", "not a text file"),
    ],
)
def test_a_bad_csv_is_named_with_its_line_and_the_others_go_on(
    spoil, message, tmp_path, small, capsys
):
    frames = small.frames[20].copy()
    frames[:, 0] = 0
    write_csv(tmp_path / "bad.csv", frames)
    (tmp_path / "bad.csv").write_text(spoil((tmp_path / "bad.csv").read_text()))
    assert re.search(
        message, errors_of(capsys, "diagnose", tmp_path / "bad.csv", "--shape", "2x6x5")
    )
    for i in range(3):
        write_csv(tmp_path / f"good{i}.csv", small.frames[20 + i])
    assert main(["diagnose", str(tmp_path), "--shape", "2x6x5"]) in (0, 1, 2)
    said = capsys.readouterr()
    assert "in 3 recordings" in said.out
    assert re.search(rf"error: .*bad\.csv.*({message})", said.err)


def test_short_recordings_and_missing_readings_are_told_and_kept(tmp_path, small, capsys):
    for i in range(12):
        write_csv(tmp_path / f"r{i}.csv", small.frames[20 + i][: 39 if i == 1 else 40])
    text = (tmp_path / "r2.csv").read_text().splitlines()
    text[6] = "nan" + text[6][text[6].index(",") :]
    (tmp_path / "r2.csv").write_text("\n".join(text))
    main(["diagnose", str(tmp_path), "--shape", "2x6x5"])
    said = capsys.readouterr()
    assert "in 12 recordings (479 frames)" in said.out
    assert re.search(r"warning: .*r1\.csv.*39", said.err)
    assert re.search(r"warning: .*r2\.csv.*line 7", said.err)
    main(["diagnose", str(tmp_path), "--shape", "2x6x5", "--frames", "40"])
    assert "in 11 recordings" in capsys.readouterr().out


def test_a_label_table_that_names_a_missing_file_is_told_and_the_rest_is_used(
    tmp_path, small, capsys
):
    names = [f"r{i}.csv" for i in range(len(small))]
    for name, frames in zip(names, small.frames, strict=True):
        write_csv(tmp_path / name, frames)
    rows = [f"{name},{small.class_names[y]}" for name, y in zip(names, small.labels, strict=True)]
    (tmp_path / "labels.csv").write_text("\n".join(["file,label", "gone.csv,normal", *rows]))
    train = [
        "train",
        str(tmp_path),
        "--shape",
        "2x6x5",
        "--out",
        str(tmp_path / "model"),
        "--epochs",
        "1",
        "--quiet",
    ]
    assert main(train) == 1
    told = capsys.readouterr().err
    assert re.search(r"error: .*labels\.csv, line 2.*gone\.csv", told)
    assert told.splitlines()[-1].endswith("1 file or recording was left out; see the errors above")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["diagnose", "{home}/gone.npz"], "gone.npz"),
        (["diagnose", "{home}/grasps.npz", "--shape", "2x11x10"], "2 x 6 x 5"),
        (["diagnose", "{home}/grasps.npz", "--shape", "2x6"], "the layout has 1 x 2 x 6"),
        (["diagnose", "{home}/grasps.npz", "--layout", "{home}/gone.json"], "gone.json"),
        (["train", "{home}/log_only.npz", "--out", "{home}/m"], "no labels"),
        (
            ["adapt", "{home}/model", "{home}/grasps.npz", "--faults", "60", "--out", "{home}/a"],
            "F names cell 60",
        ),
        (
            ["adapt", "{home}/model", "{home}/grasps.npz", "--faults", "what", "--out", "{home}/a"],
            "no such file",
        ),
        (
            [
                "adapt",
                "{home}/model",
                "{home}/grasps.npz",
                "--faults",
                "{all}",
                "--out",
                "{home}/a",
            ],
            "all 60 cells",
        ),
        (
            ["adapt", "{home}", "{home}/grasps.npz", "--faults", "1", "--out", "{home}/a"],
            "manifest.json",
        ),
        (
            ["evaluate", "{home}/model", "{home}/grasps.npz", "--inject", "row:9:9=open"],
            "row:9:9=open",
        ),
        (
            ["evaluate", "{home}/model", "{home}/grasps.npz", "--inject", "cell:0:0:0=stuck:9"],
            "outside 0..5",
        ),
        (
            [
                "convert",
                "{home}/grasps.npz",
                "--out",
                "{home}/x.npz",
                "--inject",
                "cell:0:0:0=stuck:",
            ],
            "could not convert",
        ),
        (
            ["evaluate", "{home}/model", "{home}/grasps.npz", "--inject", "melted"],
            "expected break the sensor",
        ),
        (
            ["adapt", "{home}/model", "{home}/grasps.npz", "--faults", "1"],
            "needs --out FOLDER or --forecast",
        ),
        (["adapt", "{home}/model", "{home}/grasps.npz", "--forecast"], "nothing to do"),
        (
            ["adapt", "{home}/model", "--faults", "1", "--forecast"],
            "give the fault-free recordings",
        ),
        (["forecast", "{home}/model", "{home}/grasps.npz"], "give --faults F, or --worst"),
        (
            ["forecast", "{home}/model", "{home}/grasps.npz", "--worst", "--new", "5"],
            "--new needs --faults",
        ),
        (
            ["forecast", "{home}/model", "{home}/grasps.npz", "--faults", "1", "--worst"],
            "give --faults F, or --worst",
        ),
        (
            ["forecast", "{home}/model", "{home}/grasps.npz", "--faults", "1", "--picture", "a"],
            "--picture needs --worst",
        ),
        (["evaluate", "{home}/model", "{home}/grasps.npz", "--adapted", "{home}/gone"], "gone"),
        (
            ["evaluate", "{home}/model", "{home}/grasps.npz", "--device", "abacus"],
            "--device abacus",
        ),
        (
            [
                "adapt",
                "{home}/model",
                "{home}/grasps.npz",
                "--faults",
                "1",
                "--forecast",
                "--device",
                "abacus",
            ],
            "--device abacus",
        ),
    ],
)
def test_unusable_input_is_one_line_and_exit_code_3(home, small, arguments, message, capsys):
    save_npz(home / "log_only.npz", Recordings(small.frames[:3], SMALL))
    every = ",".join(f"{cell:04d}" for cell in range(60))  # longer than any file's name can be
    assert message in errors_of(capsys, *(a.format(home=home, all=every) for a in arguments))


def test_f_empty_leaves_the_model_as_it_was(home, capsys):
    empty = [
        "adapt",
        str(home / "model"),
        str(home / "grasps.npz"),
        "--faults",
        "",
        "--out",
        str(home / "same"),
    ]
    assert main([*empty, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["scores"]["accuracy"] == result["fault_free_accuracy"]


def test_a_model_is_evaluated_with_and_without_its_head_and_by_whole_recordings(home, capsys):
    model = str(home / "model")
    grasps = str(home / "grasps.npz")
    for head in ("auto", "linear"):
        assert main(["evaluate", model, grasps, "--head", head, "--json", "--quiet"]) == 0
        result = json.loads(capsys.readouterr().out)
        # 60 frames in a recording, 10 in a window
        assert result["scores"]["n"] == 6 * result["recordings"]["n"]
        assert 0 <= result["recordings"]["accuracy"] <= 1
    assert main(["forecast", model, grasps, "--faults", "3", "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["schema"] == "adaptfault.forecast/1"


def test_a_robot_forecasts_and_adapts_without_the_recordings(home, capsys):
    model, grasps, kept = (str(home / name) for name in ("model", "grasps.npz", "adapter"))
    assert main(["adapt", model, grasps, "--keep", kept, "--quiet"]) == 0
    assert main(["adapt", kept, "--faults", "3,17,20", "--forecast", "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "expected accuracy without 3 cells" in said
    assert "suffers most" in said
    there = str(home / "there")
    here = str(home / "here")
    assert (
        main(
            [
                "adapt",
                kept,
                "--faults",
                "3,17,20",
                "--out",
                there,
                "--method",
                "head",
                "--quiet",
                "--json",
            ]
        )
        == 0
    )
    on_robot = json.loads(capsys.readouterr().out)
    assert (
        main(
            [
                "adapt",
                model,
                grasps,
                "--faults",
                "3,17,20",
                "--out",
                here,
                "--method",
                "head",
                "--json",
            ]
        )
        == 0
    )
    assert on_robot["scores"] == json.loads(capsys.readouterr().out)["scores"]
    assert main(["adapt", kept, grasps, "--faults", "3", "--forecast", "--quiet"]) == 3
    assert "leave the recordings out" in capsys.readouterr().err


@pytest.mark.parametrize("command", list(BUILT_IN))
def test_help_shows_an_example(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    assert f"example:\n  adaptfault {command}" in capsys.readouterr().out


def test_wrong_usage_is_exit_code_3(capsys):
    for arguments in (["repair"], ["train"], ["demo", "--epochs", "many"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 3
    assert "usage: adaptfault" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["info", "x.csv"], ["fleet", "maintain", "robots.toml"]])
def test_an_option_that_a_command_does_not_have_is_refused_with_the_usage_of_the_command(
    words, capsys
):
    with pytest.raises(SystemExit) as stop:
        main([*words, "--colour", "red"])
    assert stop.value.code == 3
    command = " ".join(one for one in words if "." not in one)
    told = capsys.readouterr().err
    assert told.startswith(f"usage: adaptfault {command} [-h]")
    assert f"adaptfault {command}: error: unrecognized arguments: --colour red" in told


def test_quiet_has_a_letter(tmp_path, capsys):
    log = tmp_path / "a.csv"
    log.write_text("c0,c1\n" + "0,100\n100,0\n200,500\n" * 9)
    told = []
    for quiet in ("--quiet", "-q"):
        assert main(["diagnose", str(log), "--shape", "1x2", quiet]) in (0, 1, 2)
        told.append(capsys.readouterr())
    assert told[0] == told[1]


def numeric_options(
    parser: argparse.ArgumentParser, command: tuple[str, ...] = ()
) -> Iterator[tuple[str, ...]]:
    """Yield each option that takes a number, after its command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, of_command in action.choices.items():
                of_command.fill()
                yield from numeric_options(of_command, (*command, name))
        elif action.type in (int, float):
            yield (*command, action.option_strings[-1])


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e400", "-1", "-0.5"])
def test_every_numeric_option_refuses_what_is_negative_or_not_finite(number, capsys):
    parser = parser_of()  # once: main makes it for each call
    options = list(numeric_options(parser))
    assert ("maintain", "--budget") in options
    assert ("fleet", "maintain", "--budget") in options
    for option in options:
        with pytest.raises(SystemExit) as end:
            parser.parse_args([*option, number])
        assert end.value.code == 3
        assert f"argument {option[-1]}: " in capsys.readouterr().err


def test_help_comes_without_loading_torch_or_scikit_learn():
    code = (
        "import sys; from adaptfault.cli import main\n"
        "try: main(['demo', '--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit(any(m in sys.modules for m in ('torch', 'sklearn', 'numpy')))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode
        == 0
    )


def test_diagnose_and_maintain_have_one_meaning_of_the_exit_code(
    bundle, later_grasps, broken_row, tmp_path, capsys
):
    frames = tuple(inject(r, [broken_row], SMALL) for r in later_grasps)
    save_npz(tmp_path / "log.npz", Recordings(frames, SMALL))
    log = str(tmp_path / "log.npz")
    reference = ["--reference", str(bundle.path), "--quiet"]
    assert main(["diagnose", log, *reference]) == 2  # nothing handles the row yet
    assert "handled" not in capsys.readouterr().out
    handled = main(["maintain", str(bundle.path), log, "--quiet"])
    capsys.readouterr()
    assert main(["diagnose", log, *reference]) == handled
    says = capsys.readouterr().out.splitlines()[-1]
    assert (f"handled: version 2 of {bundle.path} runs without these cells" == says) == (
        handled == 1
    )
    assert main(["rollback", str(bundle.path)]) == 0
    assert (
        main(["diagnose", log, *reference])
        == main(["maintain", str(bundle.path), log, "--quiet"])
        == 2
    )


def test_exchanged_rows_are_told_and_the_log_is_diagnosed_with_them_put_back(
    bundle, later_grasps, broken_row, tmp_path, capsys
):
    grid = SMALL.grid(np.arange(SMALL.n_cells))
    grid[0, [1, 4]] = grid[0, [4, 1]]
    broken = [inject(r, [broken_row], SMALL) for r in later_grasps]
    save_npz(tmp_path / "log.npz", Recordings(tuple(r[:, grid.ravel()] for r in broken), SMALL))
    command = ["diagnose", str(tmp_path / "log.npz"), "--reference", str(bundle.path), "--quiet"]
    assert main([*command, "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert told["rewiring"] == ["rows 1 and 4 of pad 0 are exchanged"]
    assert set(Diagnosis.from_dict(told).fault_set) == set(broken_row.cells)
    assert main(command) == 2
    assert "wiring changed: rows 1 and 4 of pad 0 are exchanged" in capsys.readouterr().out


def test_a_replaced_pad_is_told_by_diagnose_as_by_maintain(
    bundle, later_grasps, tmp_path, capsys, monkeypatch
):
    # on 30 cells, gains look like exchanged rows
    monkeypatch.setattr(SelfDiagnosis, "rewiring", lambda *given: None)
    rng = np.random.default_rng(0)
    on = SMALL.pad_of == 1
    gain = np.where(on, np.exp(rng.uniform(np.log(0.5), np.log(2), SMALL.n_cells)), 1.0)
    offset = np.where(on, rng.uniform(0, 0.008, SMALL.n_cells) * SMALL.full_scale, 0.0)
    recordings = tuple(
        np.clip(gain * frames + offset, 0, SMALL.full_scale) for frames in later_grasps
    )
    save_npz(tmp_path / "log.npz", Recordings(recordings, SMALL))
    log = str(tmp_path / "log.npz")
    main(["diagnose", log, "--reference", str(bundle.path), "--json", "--quiet"])
    assert json.loads(capsys.readouterr().out)["replaced_pads"] == [1]
    main(["maintain", str(bundle.path), log, "--quiet", "--dry-run"])
    assert "pad 1 replaced" in capsys.readouterr().out


def test_exchanged_rows_that_the_version_undoes_are_put_back_in_a_log_too_large_for_the_memory(
    bundle, later_grasps, broken_row, tmp_path, capsys, monkeypatch
):
    grid = SMALL.grid(np.arange(SMALL.n_cells))
    grid[0, [1, 4]] = grid[0, [4, 1]]
    healthy = bundle.parts.adapter().adapt(FaultSet((), SMALL.n_cells), method="fill")
    bundle.deploy(bundle.write_version(healthy, {"source": grid.ravel().tolist()}).number)
    broken = [inject(r, [broken_row], SMALL) for r in later_grasps]
    save_npz(tmp_path / "log.npz", Recordings(tuple(r[:, grid.ravel()] for r in broken), SMALL))
    monkeypatch.setattr(Opened.parts, "__defaults__", (1000 * SMALL.n_cells,))
    assert (
        main(
            [
                "diagnose",
                str(tmp_path / "log.npz"),
                "--reference",
                str(bundle.path),
                "--json",
                "--quiet",
            ]
        )
        == 2
    )
    assert set(Diagnosis.from_dict(json.loads(capsys.readouterr().out)).fault_set) == set(
        broken_row.cells
    )


def test_diagnose_tells_of_a_change_of_the_whole_sensor(
    made_bundle, small, later_grasps, tmp_path, capsys
):
    save_npz(tmp_path / "healthy.npz", small)
    for reference, gain in (
        (made_bundle, 1.0),
        (made_bundle, 0.2),
        (tmp_path / "healthy.npz", 0.2),
    ):
        save_npz(tmp_path / "log.npz", Recordings(tuple(gain * r for r in later_grasps), SMALL))
        command = [
            "diagnose",
            str(tmp_path / "log.npz"),
            "--reference",
            str(reference),
            "--json",
            "--quiet",
        ]
        code = main([*command, "--html", str(tmp_path / "page.html")])
        change = json.loads(capsys.readouterr().out)["change"]
        page = (tmp_path / "page.html").read_text()
        assert (code > 0) == (change is not None) == ("Nothing to do" not in page) == (gain < 1)
    assert change["gain"] < 0.5
    assert change["reason"][1:] in page


@pytest.mark.parametrize(
    ("what", "told"), [("strap", "pad 0 changed"), ("gloves", "sensor changed")]
)
def test_diagnose_tells_of_a_strap_and_of_gloves(
    made_bundle, later_grasps, tmp_path, capsys, what, told
):
    save_npz(tmp_path / "log.npz", Recordings(tuple(worn(later_grasps, SMALL, what)), SMALL))
    code = main(["diagnose", str(tmp_path / "log.npz"), "--reference", str(made_bundle), "--quiet"])
    said = capsys.readouterr().out
    assert code > 0
    assert told in said
    assert "wiring changed" not in said


def test_a_log_that_tests_nothing_exits_with_the_code_that_is_set(made_bundle, tmp_path, capsys):
    save_npz(tmp_path / "still.npz", Recordings(tuple(np.zeros((60, 60)) for _ in range(6)), SMALL))
    for command in (
        ["diagnose", str(tmp_path / "still.npz"), "--reference", str(made_bundle)],
        ["maintain", str(made_bundle), str(tmp_path / "still.npz"), "--dry-run"],
    ):
        assert main([*command, "--quiet"]) == 1
        assert "only 0% of the cells" in capsys.readouterr().out
        assert [
            main([*command, "--quiet", "--untested-code", str(code)]) for code in (0, 2, 3)
        ] == [0, 2, 3]


@pytest.mark.usefixtures("wholly_fitted")
def test_the_fit_reports_shares_that_rise_to_all_of_it(small):
    shares = []
    SelfDiagnosis(SMALL).fit(small.frames[::4], progress=shares.append)
    assert len(shares) > 30
    assert shares == sorted(shares)
    assert (shares[0] < 0.1, shares[-1]) == (True, 1.0)


def test_training_shows_batches_with_an_end_and_warnings_stand_on_lines_of_their_own(small, capsys):
    windows = make_windows(small.frames, small.labels, SMALL)
    model = TactileTransformer(SMALL, 3)
    train(
        model,
        windows.select(slice(0, 100)),
        windows.select(slice(100, 140)),
        epochs=2,
        progress=True,
    )
    shown = capsys.readouterr().err
    assert "epoch 2 of 2: 100%" in shown
    assert "8/8" in shown  # 2 epochs of 4 batches
    handler = LogAboveBars()
    handler.emit(
        logging.LogRecord("adaptfault", logging.WARNING, "", 0, "the disk is full", None, None)
    )
    assert capsys.readouterr().err == "the disk is full\n"


def test_verbose_tells_how_files_are_read_and_where_an_error_arose(home, tmp_path, capsys):
    shutil.copy(home / "grasps.npz", tmp_path)
    (tmp_path / "notes.doc").write_text("pressed by hand")
    assert main(["info", str(tmp_path), "-v"]) == 0
    said = capsys.readouterr().err
    assert "grasps.npz: read by adaptfault.data.recordings.formats.npz" in said
    assert "notes.doc: passed over" in said
    assert main(["info", str(tmp_path)]) == 0
    assert "passed over" not in capsys.readouterr().err
    assert main(["diagnose", str(tmp_path), "--reference", str(tmp_path / "notes.doc"), "-v"]) == 3
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert said.splitlines()[-1].startswith("adaptfault diagnose: error: ")
