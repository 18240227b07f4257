"""A quick check finds what holds a value, calls no cell tested, and says what it leaves."""

import json
import re
import subprocess
import sys
from itertools import pairwise

import jsonschema
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import hypergeom

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, load, save_npz
from adaptfault.data.recordings.facts.rates import Clock
from adaptfault.data.simulated_grasps import simulate
from adaptfault.inspection.quick import quick, quick_check
from adaptfault.inspection.quick_statistics import Statistics
from adaptfault.inspection.sample_bound import most_faulty
from adaptfault.schemas import schema_of
from diagnostics import SensorLayout, Verdict
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.when import Spans
from diagnostics.when.together import Together

LAYOUT = SensorLayout(1, 6, 6, full_scale=3.3, unit="V", rate=20.0)
MIDDLE = LAYOUT.cell(0, 3, 3)


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    frames = simulate(6, LAYOUT, n_frames=50, seed=3).frames
    order = np.random.default_rng(0).permutation(len(frames))
    return [np.asarray(frames[i], dtype=np.float32) for i in order]


def changed(grasps: list[np.ndarray], where: slice, cell: int, values) -> list[np.ndarray]:
    log = [one.copy() for one in grasps]
    for one in log[where]:
        one[:, cell] = values(len(one))
    return log


@pytest.mark.parametrize("where", [slice(None), slice(12, None), slice(14, 28)])
def test_what_holds_a_value_in_some_recordings_is_found_and_nothing_is_called_alive(where, grasps):
    log = changed(grasps, where, MIDDLE, lambda n: np.full(n, 1.1))
    found = quick(Statistics.of(Recordings(tuple(log), LAYOUT)))
    diagnosis = found.inspection.diagnosis
    assert Verdict.ALIVE not in diagnosis.verdicts
    if where == slice(None):  # it never works: the whole check finds it
        assert not found.answers[MIDDLE]
        assert any(f"never move ({LAYOUT.place(MIDDLE)}" in one.what for one in found.unchecked)
    else:
        assert set(diagnosis.fault_set) == {MIDDLE}
        assert found.inspection.severity == 1
        assert set(diagnosis.faults[0].recordings or ()) <= set(range(len(log))[where])


def test_of_a_healthy_set_nothing_is_told_but_that_it_was_not_tested(grasps):
    log = Recordings(tuple(grasps), LAYOUT)
    statistics = Statistics.of(log)
    found = quick(statistics)
    (told,) = found.inspection.findings
    assert (told.name, told.severity) == ("untested", 1)
    assert f"{LAYOUT.n_cells} of {LAYOUT.n_cells} cells were not tested" in told.reason
    assert found.answers.mean() > 0.8
    checked = quick_check(statistics, found, Clock())
    assert checked.to_dict()["level"] == "quick"
    assert "was not tested" in checked.findings.unchecked[0].what
    assert checked.badge().count("not tested")


def test_a_cell_that_moves_by_itself_does_not_answer(grasps):
    rng = np.random.default_rng(1)
    log = changed(grasps, slice(None), MIDDLE, lambda n: 1 + 0.3 * rng.standard_normal(n))
    found = quick(Statistics.of(Recordings(tuple(log), LAYOUT)))
    assert not found.answers[MIDDLE]
    told = next(one.what for one in found.unchecked if "not together" in one.what)
    assert LAYOUT.place(MIDDLE) in told


def test_where_hardly_a_cell_answers_the_set_does_not_pass():
    rng = np.random.default_rng(0)
    alone = [rng.uniform(0, 3, (50, 36)).astype(np.float32) for _ in range(8)]
    (told,) = quick(Statistics.of(Recordings(tuple(alone), LAYOUT))).inspection.findings
    assert (told.name, told.severity) == ("untested", 1)


@settings(max_examples=20, deadline=None)
@given(cuts=st.sets(st.integers(1, 149)), missing=st.booleans(), seed=st.integers(0, 99))
def test_how_a_set_is_cut_into_pieces_does_not_matter(cuts, missing, seed):
    rng = np.random.default_rng(seed)
    readings = rng.uniform(0, 3, (150, 36))
    if missing:
        readings[rng.random(readings.shape) < 0.1] = np.nan
    lengths = [60, 50, 40]
    ends = np.cumsum(lengths)
    recordings = np.split(readings, ends[:-1])
    pieces = np.split(readings, sorted(cuts | set(ends[:-1].tolist())))
    sizes = list(map(len, pieces))
    spans = Spans.of(RecordingBlocks(pieces)).whole(sizes, lengths)
    expected = Spans.of(RecordingBlocks(recordings))
    np.testing.assert_array_equal(spans.low, expected.low)
    np.testing.assert_array_equal(spans.high, expected.high)
    sums = Together.of(pieces, LAYOUT).whole(sizes, lengths).sums
    np.testing.assert_allclose(sums, Together.of(recordings, LAYOUT).sums, rtol=1e-12)


def test_the_correlation_is_that_with_the_mean_of_the_cells_beside(grasps):
    together = Together.of(grasps[:2], LAYOUT)
    beside = LAYOUT.beside[MIDDLE]
    mean = grasps[1][:, beside[beside >= 0]].astype(np.float64).mean(axis=1)
    expected = np.corrcoef(grasps[1][:, MIDDLE].astype(np.float64), mean)[0, 1]
    np.testing.assert_allclose(together.correlation[1, MIDDLE], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "code"),
    [((), 1), (("--fail-on", "never"), 1), (("--untested-code", "0"), 0)],
)
def test_what_was_not_tested_is_no_pass_unless_that_is_declared_harmless(
    options, code, grasps, tmp_path, capsys
):
    save_npz(tmp_path / "set.npz", Recordings(tuple(grasps), LAYOUT))
    assert main(["check", str(tmp_path / "set.npz"), "--quick", *options]) == code
    assert "TOUCH-190" in capsys.readouterr().out


def test_the_table_has_the_verdict_of_each_cell_in_each_recording(stored, tmp_path):
    table = tmp_path / "verdicts.parquet"
    assert main(["check", str(stored), "--quick", "--table", str(table)]) == 1
    read = pq.read_table(table).to_pylist()
    document = Statistics.of(load(stored).recordings)
    found = quick(document).inspection.diagnosis
    assert len(read) == found.n_recordings * LAYOUT.n_cells
    verdicts = np.array([one["verdict"] for one in read]).reshape(found.n_recordings, -1)
    assert (verdicts == found.by_recording.verdicts.astype(str)).all()
    shown = [one for one in read if one["code"]]
    assert {(one["code"], one["cell"], one["verdict"]) for one in shown} == {
        ("TOUCH-103", MIDDLE, "FAULTY")
    }
    faulty = {read[i * LAYOUT.n_cells]["recording"] for i in found.faults[0].recordings}
    assert {one["recording"] for one in shown} == faulty
    first = read[MIDDLE]
    assert (first["pad"], first["row"], first["column"], first["class"]) == ("0", 3, 3, "pick")


def test_the_command_says_its_level_and_waits_for_no_package_that_it_does_not_need(
    grasps, tmp_path
):
    save_npz(tmp_path / "set.npz", Recordings(tuple(grasps), LAYOUT))
    code = (
        "import sys; from adaptfault.cli import main; code = main(sys.argv[1:]);"
        "assert code == 1, code;"
        "sys.exit(str({'pandas', 'scipy', 'sklearn', 'torch', 'tqdm'} & sys.modules.keys()))"
    )
    arguments = ["check", str(tmp_path / "set.npz"), "--quick"]
    told = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert "not checked: " in told.stdout
    assert "without --quick" in told.stdout
    assert told.stderr.splitlines()[-1] == "set()"


def test_its_document_is_one_of_a_check_and_options_that_need_tested_cells_are_refused(
    grasps, tmp_path, capsys
):
    log = changed(grasps, slice(12, None), MIDDLE, lambda n: np.full(n, 1.1))
    save_npz(tmp_path / "set.npz", Recordings(tuple(log), LAYOUT))
    arguments = ["check", str(tmp_path / "set.npz"), "--quick"]
    assert main([*arguments, "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    jsonschema.validate(document, schema_of(document["schema"]))
    assert document["level"] == "quick"
    for name, value in (("--html", "page.html"), ("--write-valid", "v.npz"), ("--healthy", "0:4")):
        assert main([*arguments, name, str(tmp_path / value)]) == 3
        assert f"{name} needs tested cells" in capsys.readouterr().err


@pytest.fixture
def stored(grasps, tmp_path):
    """A data set whose cell fails in the middle."""
    log = changed(grasps, slice(12, None), MIDDLE, lambda n: np.full(n, 1.1))
    labels = np.arange(len(log)) % 2
    save_npz(tmp_path / "set.npz", Recordings(tuple(log), LAYOUT, labels, ("pick", "place")))
    return tmp_path / "set.npz"


def joined(parts: list[Statistics], draw) -> Statistics:
    """Join parts that lie side by side, two or more at a time, in any order."""
    while len(parts) > 1:
        first = draw(st.integers(0, len(parts) - 2))
        last = draw(st.integers(first + 2, len(parts)))
        parts = [*parts[:first], Statistics.joined(parts[first:last]), *parts[last:]]
    return parts[0]


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_the_verdict_of_merged_parts_is_that_of_the_whole_however_they_are_cut_and_joined(
    data, grasps
):
    log = changed(grasps, slice(14, 20), MIDDLE, lambda n: np.full(n, 1.1))
    log[1] = log[1][25:]  # begins in contact
    log[9][3:6, 4] = np.nan
    names = tuple(f"recording {i}" for i in range(len(log)))
    whole = Statistics.of(Recordings(tuple(log), LAYOUT, names=names))
    cuts = data.draw(st.sets(st.integers(1, len(log) - 1), max_size=6))
    parts = [
        Statistics.of(Recordings(tuple(log[a:b]), LAYOUT, names=names[a:b]))
        for a, b in pairwise([0, *sorted(cuts), len(log)])
    ]
    merged = joined(parts, data.draw)
    expected = quick_check(whole, quick(whole), None)
    assert "recording 1" in expected.begin_in_contact
    assert set(expected.inspection.diagnosis.fault_set) == {MIDDLE}
    assert quick_check(merged, quick(merged), None).to_dict() == expected.to_dict()


def test_parts_that_are_written_and_merged_say_what_the_whole_says(stored, tmp_path, capsys):
    assert main(["check", str(stored), "--quick", "--json"]) == 1
    whole = json.loads(capsys.readouterr().out)
    parts = [str(tmp_path / f"{i}.npz") for i in (1, 2, 3)]
    for i, part in enumerate(parts, 1):
        assert main(["check", str(stored), "--shard", f"{i}/3", "--out", part]) == 0
    capsys.readouterr()
    assert main(["check", "--merge", *parts, "--json"]) == 1
    merged = json.loads(capsys.readouterr().out)
    jsonschema.validate(merged, schema_of(merged["schema"]))
    for name in ("inspection", "findings", "begin_in_contact", "tared_in_contact", "leave_out"):
        assert merged[name] == whole[name]
    left = [one["what"] for one in merged["not_checked"]]
    assert any("parts that are merged do not hold them" in what for what in left)


def test_a_shard_reads_its_own_recordings_and_all_together_tell_what_the_whole_tells(
    grasps, tmp_path, capsys
):
    for i, one in enumerate(grasps[:16]):
        folder = tmp_path / "set" / ("pick" if i < 8 else "place")
        folder.mkdir(parents=True, exist_ok=True)
        np.savetxt(folder / f"{i:02d}.csv", one, delimiter=",", fmt="%.4f")
    (tmp_path / "set/pick/broken.csv").write_text("1,2\nx\n")  # cannot be read
    (tmp_path / "set/place/broken.npz").write_bytes(b"PK")  # nor listed
    given = [str(tmp_path / "set"), "--shape", "6x6", "--full-scale", "3.3", "--rate", "20"]
    main(["check", *given, "--quick", "--json"])
    captured = capsys.readouterr()
    whole = json.loads(captured.out)
    assert whole["left_out"] == 2
    parts = [str(tmp_path / f"{i}.part") for i in (1, 2, 3)]
    told = []
    for i, part in enumerate(parts, 1):
        main(["check", *given, "--shard", f"{i}/3", "--out", part])
        told.append("broken.csv" in capsys.readouterr().err)
    assert sum(told) == 1  # the others never look at it
    main(["check", "--merge", *parts, "--json"])
    merged = json.loads(capsys.readouterr().out)
    assert whole["summary"]["classes"] == {"pick": 8, "place": 8}
    for name in ("findings", "summary", "left_out", "begin_in_contact"):
        assert merged[name] == whole[name]


def test_what_is_no_part_or_of_another_array_is_refused(stored, tmp_path, capsys):
    part = str(tmp_path / "part.npz")
    assert main(["check", str(stored), "--shard", "1/2", "--out", part]) == 0
    other = str(tmp_path / "other.npz")
    assert main(["check", str(stored), "--full-scale", "5", "--shard", "1/2", "--out", other]) == 0
    capsys.readouterr()
    assert main(["check", "--merge", str(stored)]) == 3
    assert "is no part of a check" in capsys.readouterr().err
    assert main(["check", "--merge", str(stored), part]) == 1  # the rest goes on
    captured = capsys.readouterr()
    assert "is no part of a check" in captured.err
    assert "TOUCH-191" in captured.out
    assert main(["check", "--merge", part, other]) == 3
    assert "not of one array" in capsys.readouterr().err
    for arguments in (["--shard", "3/2", "--out", other], ["--shard", "1/2"], ["--sample", "0"]):
        assert main(["check", str(stored), *arguments]) == 3
        assert "--shard" in (told := capsys.readouterr().err) or "--sample" in told


def test_a_sample_says_how_many_recordings_hold_a_fault_at_most(stored, tmp_path, capsys):
    out = tmp_path / "sample.json"
    assert main(["check", str(stored), "--sample", "20", "--out", str(out)]) == 1
    told = capsys.readouterr().out
    assert re.search(r"in \d+ of 20 recordings drawn from \d+: with 95% confidence", told)
    document = json.loads(out.read_text())
    jsonschema.validate(document, schema_of(document["schema"]))
    one, many = document["sample"]["bounds"]
    assert (one["cells"], many["cells"]) == (1, 4)  # a tenth of 36
    assert many["found"] == 0
    drawn, of = document["sample"]["drawn"], document["sample"]["of"]
    assert one["most"] == most_faulty(one["found"], drawn, of)
    assert many["most"] == most_faulty(0, drawn, of)


@settings(max_examples=20, deadline=None)
@given(faulty=st.integers(0, 40), drawn=st.integers(1, 40), seed=st.integers(0, 1000))
def test_the_bound_of_a_sample_holds_for_the_whole(faulty, drawn, seed):
    """Over many draws of one set, the bound is below the truth in at most one of twenty."""
    rng = np.random.default_rng(seed)
    holds = np.arange(40) < faulty
    found = [int(rng.permutation(holds)[:drawn].sum()) for _ in range(300)]
    missed = np.mean([most_faulty(k, drawn, 40) < faulty for k in found])
    assert missed <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 300)


@given(of=st.integers(1, 60), data=st.data())
def test_the_bound_of_a_sample_is_the_largest_number_that_is_not_refuted(of, data):
    drawn = data.draw(st.integers(1, of))
    found = data.draw(st.integers(0, drawn))
    most = most_faulty(found, drawn, of)
    assert found <= most <= of - (drawn - found)
    assert most == found or hypergeom.cdf(found, of, most, drawn) > 0.05 - 1e-9
    if most < of - (drawn - found):
        assert hypergeom.cdf(found, of, most + 1, drawn) < 0.05 + 1e-9
