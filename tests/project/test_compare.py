"""The comparisons with other tools treat all alike, go on where they were, and own up to what they
lose."""

import signal
import sys
import time
from multiprocessing import Pipe, get_context
from pathlib import Path

import numpy as np
import pytest

import adaptfault as af
from diagnostics import FaultSet, SensorLayout

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch):
    """The examples' own folder on the path, as when one of them runs."""
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture
def task(examples, grasps):
    from compare.classifiers import SMALL, Task

    windows = af.make_windows(grasps.frames, grasps.labels, grasps.layout)
    return Task(grasps.layout, *af.split(windows), 0, True, SMALL)


def test_no_peer_sees_a_dead_cell(task):
    from compare.classifiers import PEERS
    from compare_classification import quiet

    faults = FaultSet((3, 40, 41, 120), task.layout.n_cells)
    garbled = task.test.x.copy()
    garbled[..., list(faults)] = np.random.default_rng(0).random(garbled[..., list(faults)].shape)
    installed = [peer for peer in PEERS if peer.package == "scikit-learn"]
    assert len(installed) >= 3
    for peer in installed:
        with quiet():
            predict = peer.prepare(task)(faults)
            np.testing.assert_array_equal(predict(garbled), predict(task.test.x), err_msg=peer.name)


def test_what_peers_print_is_kept_back_in_an_encoding(examples, capsys: pytest.CaptureFixture[str]):
    from compare_classification import quiet

    with quiet():
        assert sys.stdout.encoding == "utf-8"  # PyPOTS prints a logo, and asks before
        print("═╗")
    assert capsys.readouterr().out == ""


def test_what_learns_from_losses_sees_each_window_whole_and_broken(task):
    x, y = task.with_losses(task.train)
    n = len(task.train)
    np.testing.assert_array_equal(x[:n], task.train.x[..., task.healthy()])
    np.testing.assert_array_equal(y, np.tile(task.train.y, 2))
    gone = np.isnan(x[n:])
    assert (gone.any(axis=1) == gone.all(axis=1)).all()  # a dead cell is dead for the whole window
    for recording in np.unique(task.train.recording):
        mine = gone[task.train.recording == recording]
        assert (mine == mine[0]).all()
    assert 0.05 < gone.mean() < 0.8


def test_a_comparison_goes_on_where_it_was_killed(task, tmp_path: Path):
    from compare.classifiers import Peer
    from compare_classification import compare

    prepared = []

    def prepare(task):
        prepared.append(task.seed)
        return lambda faults: lambda x: np.full(len(x), len(faults))

    path = tmp_path / "classification.csv"
    first = compare([task], [Peer("a", "none", "ready", prepare)], True, path)
    both = [Peer("a", "none", "ready", prepare), Peer("b", "none", "anew", prepare)]
    # killed before the last line
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    again = compare([task], both, True, path)
    assert [(row.name, row.faults) for row in again] == [("a", row.faults) for row in first] + [
        ("b", row.faults) for row in first if row.dead
    ]
    assert len(prepared) == 3
    assert compare([task], both, True, path) == compare([task], both, True, path)
    assert len(prepared) == 3


def test_one_peers_failure_is_not_the_end(task, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from compare.classifiers import Peer
    from compare_classification import compare

    def fails(task):
        raise MemoryError("too large")

    peers = [
        Peer("a", "none", "ready", fails),
        Peer("b", "none", "ready", lambda t: lambda f: lambda x: t.test.y),
    ]
    rows = compare([task], peers, True, tmp_path / "classification.csv")
    assert {row.name for row in rows} == {"b"}
    assert {row.accuracy for row in rows} == {1.0}
    assert "a, seed 0: failed, MemoryError: too large" in capsys.readouterr().out


def test_where_a_peer_is_better_the_verdict_says_so(examples):
    from compare_classification import OURS, Row, summed, verdict

    def row(seed: int, name: str, accuracy: float, cpu: float) -> Row:
        return Row(seed, "one pad", 9, name, "anew", accuracy, 0.0, 0.0, 2 * cpu, cpu, 1.0)

    rows = [
        row(0, OURS, 0.5, 20.0),
        row(1, OURS, 0.6, 20.0),
        row(0, "good", 0.6, 30.0),
        row(1, "good", 0.59, 30.0),
    ]
    rows += [
        row(0, "quick", 0.4, 0.5),
        row(1, "quick", 0.4, 0.5),
        row(0, "bad", 0.1, 90.0),
        row(1, "bad", 0.1, 90.0),
    ]
    lines = list(verdict(summed(rows)))
    assert lines[0] == "  good: accuracy, one pad: +0.045 (in 1 of 2 seeds)"
    assert lines[1] == "  quick: all learning: 0 s CPU; repair: 0.50 s CPU"
    assert lines[2] == "  bad: in nothing"


def test_keras_where_it_is_better_the_verdict_says_so(examples):
    from compare_keras import BATCHES, OURS, Result, verdict

    def result(accuracy: float, epoch: float, ms: float) -> Result:
        made = Result(
            accuracy=[accuracy], first=[(9, 9)], epochs=[(2 * epoch, epoch)], megabytes=100
        )
        for batch in BATCHES:
            made.milliseconds["slow", batch] = [(9.0, 9.0)]
            made.milliseconds["fast", batch] = [(9.0, ms)]
        return made

    results = {OURS: result(0.5, 2.0, 3.0), "a": result(0.6, 1.0, 4.0), "b": result(0.4, 3.0, 2.5)}
    better = verdict(results)
    assert better[0] == "  a: accuracy: +0.100 (in 1 of 1 seeds); an epoch: 1.00 s against 2.00"
    assert (
        better[1]
        == "  b: 1 window: 2.50 ms (fast) against 3.00 (fast); 256 windows: 2.50 ms (fast) against"
        " 3.00 (fast)"
    )


def test_a_stack_that_hangs_is_killed_and_out(examples):
    from compare_keras import Worker

    line, far = Pipe()
    process = get_context("spawn").Process(target=time.sleep, args=(600,))
    process.start()
    worker = Worker("Keras", process, line, 0.1)
    with pytest.raises(RuntimeError, match=r"Keras failed: no answer in 0\.1 s"):
        worker.ask()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    far.send("late")
    assert worker.ask("") == "late"


@pytest.mark.filterwarnings("ignore")  # Keras's own
def test_the_network_in_keras_is_the_network(examples, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("KERAS_BACKEND", "torch")
    keras = pytest.importorskip("keras")
    from compare.stacks import as_keras, keras_network

    layout = SensorLayout(2, 5, 4)
    ours = af.TactileTransformer(layout, 3, length=6, seed=1).eval()
    theirs = keras_network(keras, layout, 3, 6)
    assert theirs.count_params() == sum(p.numel() for p in ours.parameters())
    theirs.set_weights(
        as_keras({name: w.numpy() for name, w in ours.state_dict().items()}, layout, theirs)
    )
    x = np.random.default_rng(0).random((5, 6, 40), np.float32)
    from adaptfault.models.network import logits_of

    np.testing.assert_allclose(theirs.predict(x, verbose=0), logits_of(ours, x).numpy(), atol=1e-5)


def test_what_linters_say_of_cells_is_read_from_what_they_print(examples, tmp_path):
    from compare.linters import KINDS, Tool, cells_named, grasps, others, ours, write

    told = (
        "8 dimension(s) never change: observation.tactile.left[0],\nobservation.tactile.right[79]"
    )
    boxed = (
        "observation.tactile.right: 2 constant dimension(s) across ALL │\n│ episodes: dim 0 (=0.0),"
        " dim 7 (=0.0) - x"
    )
    assert cells_named(Tool("other", ()), told, tmp_path) == {0, 159}
    assert cells_named(Tool("other", ()), boxed, tmp_path) == {80, 87}
    frames, tasks = grasps(3)
    assert [len(break_cells(frames, tasks)) for break_cells in KINDS.values()] == [0, 12, 6]
    write(tmp_path / "set", frames, tasks)
    read = af.load(tmp_path / "set", shape=(2, 10, 8), full_scale=3.3).recordings
    np.testing.assert_array_equal(np.concatenate(read.frames), np.concatenate(frames))
    assert [read.class_names[label] for label in read.labels[:4]] != ["nothing"] * 4
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/rda").touch()
    assert len({*others(tmp_path), *ours()}) == 6
