import shutil

import pytest

from adaptfault.robot.checksummed_json import Damaged
from adaptfault.robot.journal import Journal


@pytest.fixture
def journal(tmp_path) -> Journal:
    journal = Journal(tmp_path)
    journal.add("2026-01-01T00:00:00+00:00", "unchanged", {"version": 1}, [("aa", "one.csv"), ("bb", "two.csv")])
    journal.add("2026-01-02T00:00:00+00:00", "deployed", {"version": 2}, [("cc", "three.csv")])
    return journal


def test_runs_and_the_recordings_they_saw_come_back(journal):
    assert [(r["id"], r["what"], r["version"]) for r in journal.runs()] == [(1, "unchanged", 1), (2, "deployed", 2)]
    assert [r["id"] for r in journal.runs(last=1)] == [2]
    assert journal.seen(["aa", "cc", "dd"]) == {"aa", "cc"}


def test_an_empty_journal_is_no_damage(tmp_path):
    journal = Journal(tmp_path)
    assert (journal.runs(), journal.seen(["aa"]), journal.damage(repair=True)) == ([], set(), [])


def test_a_run_is_written_with_all_its_recordings_or_not_at_all(journal):
    with pytest.raises(ValueError, match="JSON"):
        journal.add("2026-01-03T00:00:00+00:00", "kept", {"x": float("nan")}, [("dd", "four.csv")])
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
    for read in (journal.runs, journal.conditions, lambda: journal.last("version"), lambda: journal.seen(["aa"])):
        if read == journal.conditions and not content:
            continue  # SQLite reads an empty file as a database without tables
        with pytest.raises(Damaged, match=r"journal.sqlite is damaged \(.*\); adaptfault maintain starts a new one"):
            read()


def test_a_broken_journal_is_set_aside_and_a_new_one_begun(journal, tmp_path):
    journal.path.write_bytes(b"x" * 5000)
    assert "renamed" in journal.damage(repair=True)[0]
    assert (tmp_path / "journal.damaged.sqlite").exists()
    assert journal.runs() == []
    journal.add("2026-01-03T00:00:00+00:00", "kept", {"version": 1})
    assert journal.damage(repair=True) == []


def test_a_crash_before_the_seal_loses_nothing(journal, tmp_path):
    seal = (tmp_path / "journal.sha256").read_bytes()
    journal.add("2026-01-03T00:00:00+00:00", "kept", {"version": 2})
    (tmp_path / "journal.sha256").write_bytes(seal)
    assert "is readable" in journal.damage(repair=True)[0]
    assert journal.damage(repair=True) == []
    assert len(journal.runs()) == 3


def test_a_crash_within_a_transaction_leaves_the_state_before(journal, tmp_path):
    import sqlite3

    other = tmp_path / "other"
    other.mkdir()
    connection = sqlite3.connect(journal.path)
    connection.execute("PRAGMA cache_size=0")
    connection.execute("BEGIN")
    connection.executemany("INSERT INTO recordings VALUES (?, 'x', 9)", [(str(i),) for i in range(5000)])
    for path in tmp_path.glob("journal.*"):  # as the disk would look after kill -9
        shutil.copy(path, other)
    connection.close()
    crashed = Journal(other)
    crashed.damage(repair=True)
    assert len(crashed.runs()) == 2
    assert crashed.seen(["aa", "17"]) == {"aa"}
