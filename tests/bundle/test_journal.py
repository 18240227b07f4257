import errno
import json
import logging
import shutil
import sqlite3
from contextlib import closing

import pytest

from adaptfault.bundle import journal as module
from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.journal import PENDING, Entry, Journal

THIRD = Entry("2026-01-03T00:00:00+00:00", "kept", {"version": 2}, [("dd", "four.csv")], b"cells")


@pytest.fixture
def journal(tmp_path) -> Journal:
    journal = Journal(tmp_path)
    two = [("aa", "one.csv"), ("bb", "two.csv")]
    journal.add(Entry("2026-01-01T00:00:00+00:00", "unchanged", {"version": 1}, two))
    journal.add(
        Entry("2026-01-02T00:00:00+00:00", "deployed", {"version": 2}, [("cc", "three.csv")])
    )
    return journal


def test_runs_and_the_recordings_they_saw_come_back(journal):
    assert [(r["id"], r["what"], r["version"]) for r in journal.runs()] == [
        (1, "unchanged", 1),
        (2, "deployed", 2),
    ]
    assert [r["id"] for r in journal.runs(last=1)] == [2]
    assert journal.seen(["aa", "cc", "dd"]) == {"aa", "cc"}


def test_an_empty_journal_is_no_damage(tmp_path):
    journal = Journal(tmp_path)
    assert (journal.runs(), journal.seen(["aa"]), journal.damage(repair=True)) == ([], set(), [])


def test_a_run_is_written_with_all_its_recordings_or_not_at_all(journal):
    with pytest.raises(ValueError, match="JSON"):
        journal.add(
            Entry("2026-01-03T00:00:00+00:00", "kept", {"x": float("nan")}, [("dd", "four.csv")])
        )
    assert journal.seen(["dd"]) == set()
    assert len(journal.runs()) == 2


def test_every_damaged_byte_is_noticed_and_what_still_reads_is_kept(journal):
    whole = journal.path.read_bytes()
    for place in range(0, len(whole), 997):
        broken = bytearray(whole)
        broken[place] ^= 4
        journal.path.write_bytes(bytes(broken))
        assert journal.damage(repair=False)
    journal.path.write_bytes(whole)
    assert journal.damage(repair=False) == []
    assert len(journal.runs()) == 2


@pytest.mark.parametrize("content", [b"", b"x" * 5000])
def test_reading_a_broken_journal_names_it_and_what_mends_it(journal, content):
    journal.path.write_bytes(content)
    for read in (
        journal.runs,
        journal.conditions,
        lambda: journal.last("version"),
        lambda: journal.seen(["aa"]),
    ):
        with pytest.raises(
            Damaged, match=r"journal.sqlite is damaged \(.*\); adaptfault maintain starts a new one"
        ):
            read()


def test_a_broken_journal_is_set_aside_and_a_new_one_begun(journal, tmp_path):
    journal.path.write_bytes(b"x" * 5000)
    assert "renamed" in journal.damage(repair=True)[0]
    assert (tmp_path / "journal.damaged.sqlite").exists()
    assert journal.runs() == []
    journal.add(Entry("2026-01-03T00:00:00+00:00", "kept", {"version": 1}))
    assert journal.damage(repair=True) == []


def test_a_crash_before_the_seal_loses_nothing(journal, tmp_path):
    seal = (tmp_path / "journal.sha256").read_bytes()
    journal.add(Entry("2026-01-03T00:00:00+00:00", "kept", {"version": 2}))
    (tmp_path / "journal.sha256").write_bytes(seal)
    assert "is readable" in journal.damage(repair=True)[0]
    assert journal.damage(repair=True) == []
    assert len(journal.runs()) == 3


def test_a_crash_within_a_transaction_leaves_the_state_before(journal, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    connection = sqlite3.connect(journal.path)
    connection.execute("PRAGMA cache_size=0")
    connection.execute("BEGIN")
    connection.executemany(
        "INSERT INTO recordings VALUES (?, 'x', 9)", [(str(i),) for i in range(5000)]
    )
    for path in tmp_path.glob("journal.*"):  # as the disk would look after kill -9
        shutil.copy(path, other)
    connection.close()
    crashed = Journal(other)
    crashed.damage(repair=True)
    assert len(crashed.runs()) == 2
    assert crashed.seen(["aa", "17"]) == {"aa"}


@pytest.mark.parametrize("made", range(4))
def test_tables_that_a_crash_left_unmade_are_made_by_the_next_run(tmp_path, made):
    journal = Journal(tmp_path)
    with closing(sqlite3.connect(journal.path)) as connection:
        for name, columns in list(module._TABLES.items())[:made]:
            connection.execute(f"CREATE TABLE {name} ({columns})")
    assert (journal.damage(repair=False), journal.runs(), journal.seen(["dd"])) == ([], [], set())
    assert (journal.conditions(), journal.last("version"), journal.damage(repair=True)) == (
        [],
        None,
        [],
    )
    journal.add(THIRD)
    assert (len(journal.runs()), journal.seen(["dd"]), journal.conditions()[0][2]) == (
        1,
        {"dd"},
        b"cells",
    )


@pytest.mark.parametrize("table", module._TABLES)
def test_a_journal_that_lost_a_table_is_set_aside(journal, tmp_path, table):
    with closing(sqlite3.connect(journal.path)) as connection:
        connection.execute(f"DROP TABLE {table}")
    assert "renamed" in journal.damage(repair=True)[0]
    assert (tmp_path / "journal.damaged.sqlite").exists()
    assert journal.runs() == []


def test_the_first_entry_is_there_whole_or_no_table_is(tmp_path, monkeypatch):
    journal = Journal(tmp_path)

    def crash(connection, entry):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_insert", crash)
    with pytest.raises(KeyboardInterrupt):
        journal.add(THIRD)
    with closing(sqlite3.connect(journal.path)) as connection:
        assert connection.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,)


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE", 0.0)
    connect = sqlite3.connect
    monkeypatch.setattr(
        sqlite3, "connect", lambda *a, timeout, **options: connect(*a, timeout=0, **options)
    )


def held(journal: Journal) -> sqlite3.Connection:
    """Return the connection of a program that holds the journal, as a backup does."""
    connection = sqlite3.connect(journal.path, timeout=0, isolation_level=None)
    connection.execute("BEGIN EXCLUSIVE")
    return connection


def test_a_journal_that_another_program_holds_is_not_damaged(journal, tmp_path, impatient):
    (tmp_path / "journal.sha256").write_text("of an earlier entry")
    with closing(held(journal)):
        for use in (journal.runs, lambda: journal.damage(repair=True), lambda: journal.add(THIRD)):
            with pytest.raises(
                OSError, match=r"journal.sqlite is held by another program .*; try again later"
            ):
                use()
    assert not (tmp_path / "journal.damaged.sqlite").exists()
    journal.damage(repair=True)
    journal.add(THIRD)
    assert len(journal.runs()) == 3


@pytest.mark.parametrize(
    "message", ["database or disk is full", "disk I/O error", "unable to open database file"]
)
def test_an_error_of_sqlite_that_is_no_damage_is_an_error_of_the_system(journal, message):
    with pytest.raises(OSError, match=message), journal._connect():
        raise sqlite3.OperationalError(message)


def test_an_entry_counts_once_the_pointer_names_it(journal, tmp_path):
    journal.prepare(THIRD, "another")
    assert journal.settle("another")  # the switch did not happen
    assert len(journal.runs()) == 2
    assert not (tmp_path / PENDING).exists()
    journal.prepare(THIRD, "another")
    assert journal.settle(THIRD.key)
    assert [run["what"] for run in journal.runs()] == ["unchanged", "deployed", "kept"]
    assert (journal.seen(["dd"]), journal.conditions()[0][2]) == ({"dd"}, b"cells")


def test_an_entry_is_journalled_once_however_often_it_is_settled(journal, tmp_path):
    journal.prepare(THIRD, "another")
    waiting = (tmp_path / PENDING).read_bytes()
    journal.settle(THIRD.key)
    (tmp_path / PENDING).write_bytes(waiting)  # as after a crash before it was removed
    assert journal.settle(THIRD.key)
    assert len(journal.runs()) == 3


def test_entries_wait_in_order_while_the_journal_is_held_and_this_is_told_once(
    journal, impatient, caplog
):
    later = Entry("2026-01-04T00:00:00+00:00", "confirmed", {"version": 3})
    never = Entry("2026-01-05T00:00:00+00:00", "rollback", {"version": 3})
    with closing(held(journal)):
        journal.prepare(THIRD, "another")
        assert not journal.settle(THIRD.key)
        journal.prepare(later, THIRD.key)
        assert not journal.settle(later.key)
        journal.prepare(never, later.key)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "its new entries wait in journal.pending.json" in caplog.text
    assert journal.settle(later.key)
    assert [run["what"] for run in journal.runs()] == ["unchanged", "deployed", "kept", "confirmed"]


def test_waiting_entries_that_cannot_be_read_stay_until_they_can_or_the_next_switch_replaces_them(
    journal, tmp_path
):
    journal.prepare(THIRD, "another")
    whole = (tmp_path / PENDING).read_bytes()
    for content in (b"", b"{}", json.dumps({**json.loads(whole), "entries": 3}).encode()):
        (tmp_path / PENDING).write_bytes(content)
        assert not journal.settle(THIRD.key)
        assert (tmp_path / PENDING).read_bytes() == content
    later = Entry("2026-01-04T00:00:00+00:00", "confirmed", {"version": 3})
    journal.prepare(later, THIRD.key)
    assert journal.settle(later.key)
    (tmp_path / PENDING).write_bytes(whole)
    assert journal.settle(THIRD.key)
    assert [run["what"] for run in journal.runs()] == ["unchanged", "deployed", "confirmed", "kept"]


def test_a_checksum_that_cannot_be_written_costs_no_entry(journal, monkeypatch, caplog):
    def full(path, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module, "atomic_write", full)
        journal.add(THIRD)
    assert "No space left" in caplog.text
    assert len(journal.runs()) == 3
    assert "is readable" in journal.damage(repair=True)[0]
    assert journal.damage(repair=True) == []
