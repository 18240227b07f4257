"""No output of a command may be what it reads, whatever the command and however it is spelled."""

import argparse
import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from adaptfault.cli import main, parser_of
from adaptfault.cli.paths import Read, Written
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.valid import write_valid
from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 2, 2, full_scale=1.0)
NO_PATHS = {
    *("key", "topic", "field", "columns", "ignore", "time_column", "label_column", "unit", "shape"),
    "shard",
    *(
        "device",
        "fail_on",
        "code",
        "inject",
        "name",
        "healthy",
        "take",
        "leave",
        "classes",
        "builder",
        "host",
        "relay",
    ),
    *("when", "dask", "ticks", "command"),
}


def commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of all commands by their words."""
    found = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                inner.fill()
                further = commands(inner)
                found |= {f"{name} {word}": one for word, one in further.items()} or {name: inner}
    return found


COMMANDS = commands(parser_of())


def of_kind(parser: argparse.ArgumentParser, kind: type) -> list[argparse.Action]:
    """Return the options of a parser whose values are of a kind."""
    return [action for action in parser._actions if isinstance(value_of(action), kind)]


def value_of(action: argparse.Action) -> object:
    """Return what an option makes of a name; nothing where it takes no text."""
    if not callable(action.type) or action.type in (int, float):
        return ""
    with contextlib.suppress(argparse.ArgumentTypeError):
        return action.type("x.prom")
    return ""


PAIRS = [
    (words, written.dest, read.dest)
    for words, parser in COMMANDS.items()
    for written in of_kind(parser, Written)
    for read in of_kind(parser, Read)
]


def world(folder: Path) -> Path:
    """Make what commands read: recordings, a folder of them, what stands for a bundle."""
    given = folder / "given"
    (given / "inner").mkdir(parents=True)
    for name in ("bundle.json", "manifest.json", "inner/a.npz", "inner/b.prom"):
        (given / name).write_text(f"{name}, not to be lost")
    (folder / "one.prom").write_text("one, not to be lost")
    (folder / "link.prom").symlink_to("one.prom")
    os.link(folder / "one.prom", folder / "hard.prom")
    (folder / "links").symlink_to("given")
    return folder


SPELLINGS = {
    "one.prom": [
        "one.prom",
        "./one.prom",
        "given/../one.prom",
        "link.prom",
        "hard.prom",
        "one.prom/",
    ],
    "given": [
        *("given", "given/", "./given/.", "links", "given/inner/..", "given/inner/b.prom"),
        *("links/inner/b.prom", "given/inner/../inner/b.prom", "given/bundle.json", "."),
    ],
}
_ALIKE = [(given, output) for given, outputs in SPELLINGS.items() for output in outputs]


def command_line(words: str, written: str, read: str, given: str, output: str) -> list[str]:
    """Return a command that reads ``given`` and writes ``output``; all else that it needs is
    there."""
    line = words.split()
    grouped = {
        id(action)
        for group in COMMANDS[words]._mutually_exclusive_groups
        for action in group._group_actions
    }
    for action in COMMANDS[words]._actions:
        value = None
        if action.dest == read:
            value = given
        elif action.dest == written:
            value = output
        elif action.required and id(action) not in grouped:
            value = "1" if action.type is int else "given"
            if isinstance(action.type, type) and issubclass(action.type, Written):
                value = "new"
        if value is not None:
            line += [*action.option_strings[:1], value]
    return line


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = world(tmp_path_factory.mktemp("paths"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


def test_each_option_says_whether_it_is_a_path_that_is_read_or_written():
    unknown = [
        f"{words} {action.dest}"
        for words, parser in COMMANDS.items()
        for action in parser._actions
        if action.nargs != 0
        and action.choices is None
        and action.type not in (int, float)
        and action.dest not in NO_PATHS
        and action not in of_kind(parser, Read | Written)
        and not (words == "listen" and action.dest == "sets")
    ]
    assert unknown == []
    assert len(PAIRS) > 80


@given(pair=st.sampled_from(PAIRS), alike=st.sampled_from(_ALIKE))
def test_an_output_that_names_an_input_is_refused_and_nothing_is_lost(place, pair, alike):
    given, output = alike
    before = contents(place)
    words, written, read = pair
    if written == "metrics":  # whose name has its own rule
        output = output.rstrip("/")
        assume(output.endswith(".prom"))
    with contextlib.redirect_stderr(io.StringIO()) as said:
        assert main(command_line(words, written, read, given, output)) == 3
    assert contents(place) == before
    assert len(said.getvalue().splitlines()) == 1


@pytest.mark.parametrize(("words", "written", "read"), PAIRS)
def test_no_command_writes_onto_what_it_reads(place, capsys, words, written, read):
    given = "given" if read in ("bundle", "model", "adapted") else "one.prom"
    output = "links/inner/b.prom" if given == "given" else "hard.prom"
    main(command_line(words, written, read, given, output))
    said = capsys.readouterr().err
    assert "read" in said
    assert f"--{written.replace('_', '-')} {output}: " in said


def test_a_new_name_beside_the_recordings_and_a_result_of_an_earlier_run_are_written(
    tmp_path, capsys
):
    rng = np.random.default_rng(0)
    (tmp_path / "log").mkdir()
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / "log" / name, rng.uniform(0, 1, (1, 60, 1, 3, 4)))
    for out in ("log/d.json", "d.json"):
        for _ in range(2):  # again onto the first
            main(["diagnose", str(tmp_path / "log"), "--out", str(tmp_path / out), "--quiet"])
            assert json.loads((tmp_path / out).read_bytes())["schema"] == "adaptfault.diagnosis/1"
    (tmp_path / "log" / "notes.json").write_text("{}")
    notes = str(tmp_path / "log" / "notes.json")
    assert main(["diagnose", str(tmp_path / "log"), "--out", notes]) == 3
    assert main(["convert", str(tmp_path / "log"), "--out", str(tmp_path / "log" / "c.npz")]) == 3
    out, err = capsys.readouterr()
    assert "would be read as a recording" in err


def test_the_layout_beside_a_file_that_is_read_is_kept(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.zeros((1, 60, 1, 3, 4)))
    layout = tmp_path / "layout.json"
    layout.write_text(json.dumps(LAYOUT.to_dict()))
    for output in (layout, tmp_path / "." / "layout.json"):
        assert main(["info", str(tmp_path / "a.npy"), "--write-layout", str(output)]) == 3
    assert json.loads(layout.read_text()) == LAYOUT.to_dict()
    assert "is read by this command" in capsys.readouterr().err


def test_two_outputs_of_one_name_are_refused(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.zeros((1, 60, 1, 3, 4)))
    twice = ["--out", str(tmp_path / "b"), "--html", str(tmp_path / "." / "b")]
    assert main(["diagnose", str(tmp_path / "a.npy"), *twice]) == 3
    assert "--out names it, too" in capsys.readouterr().err


def masks():
    return iter([np.ones((3, 4), bool), np.zeros((2, 4), bool)])


@pytest.mark.parametrize("name", ["m.npz", "m.parquet", "m.zarr", "m.h5", "M.ZARR"])
def test_masks_never_take_the_place_of_a_folder_that_they_did_not_write(tmp_path, name):
    place = tmp_path / name
    place.mkdir()
    (place / "notes.txt").write_text("of somebody")
    with pytest.raises(InputError, match="holds other things than masks"):
        write_valid(place, masks(), ["a", "b"], LAYOUT)
    assert (place / "notes.txt").read_text() == "of somebody"
    shutil.rmtree(place)
    for _ in range(2):
        write_valid(place, masks(), ["a", "b"], LAYOUT)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    if place.is_dir():
        (place / "notes.txt").write_text("of somebody")
        with pytest.raises(InputError, match="holds other things than masks"):
            write_valid(place, masks(), ["a", "b"], LAYOUT)


_WRITES = """
import os, signal, sys
from pathlib import Path
import numpy as np
from adaptfault.data.recordings.valid import write_valid
from diagnostics import SensorLayout

left = int(sys.argv[2])
def count(event, args):
    global left
    if event in ("open", "os.rename", "os.mkdir", "os.remove") and sys.argv[1] in str(args[0]):
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(count)
write_valid(sys.argv[1] + "/m.zarr", iter([np.ones((3, 4), bool)]), ["a"],
            SensorLayout(1, 2, 2, full_scale=1.0))
print(left)
"""


def test_a_kill_at_any_moment_leaves_whole_masks_or_none(tmp_path):
    zarr = pytest.importorskip("zarr")
    write_valid(tmp_path / "m.zarr", iter([np.ones((3, 4), bool)]), ["a"], LAYOUT)
    command = [sys.executable, "-c", _WRITES, str(tmp_path)]
    whole = subprocess.run([*command, "1000"], capture_output=True, text=True, check=True)
    steps = 1000 - int(whole.stdout)
    assert steps > 5
    for step in (1, steps // 3, 2 * steps // 3, steps - 1, steps):
        killed = subprocess.run([*command, str(step)], capture_output=True, text=True, check=False)
        # Zarr's threads open files once more or less: the last step may lie behind the end.
        assert killed.returncode == -signal.SIGKILL or step >= steps - 1
        if (tmp_path / "m.zarr").exists():
            assert zarr.open_group(tmp_path / "m.zarr", mode="r")["data/valid"][:].all()
