"""Power cuts: every state of the disk that may follow one is a good state. The engine is
examples/disk/."""

import os
import sqlite3
from pathlib import Path

import pytest
from disk.power_cut_states import Trace, build
from power_cut import run

from adaptfault.data.atomic import atomic_write


def contents(trace: Trace, path: str) -> set:
    return {tree.get(path) for tree, _ in trace.states()}


def test_what_is_not_synced_may_be_lost_reordered_or_torn(tmp_path):
    trace = Trace(tmp_path)
    with trace.recording():
        with open(tmp_path / "new", "wb") as file:
            file.write(b"whole")
        os.replace(tmp_path / "new", tmp_path / "name")
    assert contents(trace, "name") == {None, b"", b"wh", b"\0" * 5, b"whole"}
    assert {"new", "name"} not in [set(tree) for tree, _ in trace.states()]  # a rename is atomic
    assert ({}, True) in list(trace.states())  # and may be lost


def test_an_atomic_write_leaves_the_old_content_or_the_new_and_is_durable_when_it_returns(tmp_path):
    (tmp_path / "name").write_bytes(b"old")
    trace = Trace(tmp_path)
    with trace.recording():
        atomic_write(tmp_path / "name", b"new")
    assert contents(trace, "name") == {b"old", b"new"}
    assert all(tree == {"name": b"new"} for tree, done in trace.states() if done)


def test_the_model_of_sqlites_steps_gives_databases_that_sqlite_restores(tmp_path):
    (tmp_path / "disk").mkdir()
    path = tmp_path / "disk" / "journal.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE t (x TEXT)")
        connection.executemany("INSERT INTO t VALUES (?)", [("a" * 3000,)] * 4)
    connection.close()
    trace = Trace(tmp_path / "disk")
    with trace.recording():
        connection = sqlite3.connect(path)
        connection.execute("PRAGMA synchronous=EXTRA")
        with connection:
            connection.execute("UPDATE t SET x = ?", ("b" * 3500,))
        connection.close()
    found = {False: set(), True: set()}
    for i, (tree, done) in enumerate(trace.states()):
        (place := tmp_path / str(i)).mkdir()
        build(tree, place)
        connection = sqlite3.connect(place / "journal.sqlite")
        found[done].add("".join(sorted({x[0] for (x,) in connection.execute("SELECT x FROM t")})))
        connection.close()
    assert found == {False: {"a", "b"}, True: {"b"}}


def checked(home: Path, sample: int | None) -> int:
    tried, wrong = run(sample=sample, home=home, say=lambda text: None)
    assert not wrong, wrong[:5]
    return tried


def test_after_a_power_cut_a_robot_goes_on_with_one_of_the_two_versions(tmp_path):
    assert checked(tmp_path, 3) >= 18


@pytest.mark.slow
def test_after_every_power_cut_a_robot_goes_on_with_one_of_the_two_versions(tmp_path):
    assert checked(tmp_path, None) > 1200
