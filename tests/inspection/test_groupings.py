"""A fault that goes along with a robot, a session or a data set is told."""

import json

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, open_recordings, save_npz
from adaptfault.inspection.groupings import coincide, dividing, groupings_of, read_groupings
from adaptfault.inspection.naming import Naming
from diagnostics import Diagnosis, Fault, SensorLayout, Verdict

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)
NAMES = ("a", "b", "c", "d")


def diagnosis(shown: list[int]) -> Diagnosis:
    """Return a diagnosis in which cell 5 is faulty in some of four recordings."""
    states = np.full((4, 12), int(Verdict.ALIVE), np.uint8)
    states[shown, 5] = int(Verdict.FAULTY)
    nothing = np.zeros(12)
    return Diagnosis(LAYOUT, (Fault("open", (5,)),), nothing, nothing > 0, 40, 4, states=states)


def table(path, text):
    path.write_text(text)
    return path


def test_a_fault_of_one_session_is_told_with_it(tmp_path):
    text = "robot,recording,session\nr1,a,mon\nr2,b,mon\nr1,c,tue\nr2,d,tue\n"
    groups = read_groupings(table(tmp_path / "g.csv", text), NAMES)
    assert groups == {"robot": ["r1", "r2", "r1", "r2"], "session": ["mon", "mon", "tue", "tue"]}
    (found,) = coincide(diagnosis([2, 3]), groups)
    assert (found.name, found.severity, str(found.code)) == ("coincides", 1, "TOUCH-160")
    assert "coincides with session tue and no other" in found.reason
    assert "learn the fault for the session" in found.reason
    assert coincide(diagnosis([1, 2]), groups) == []


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("\n", "is no table of groups; expected a header as recording,robot,session"),
        ("name,robot\na,1\n", "is no table of groups"),
        ("recording\na\n", "is no table of groups"),
        ("recording,robot\na,1\nb,1\na,2\n", "line 4: names a twice"),
        ("recording,robot\na,1\nb,1\nc,1\n", "has no row of d; give one"),
        ("recording,robot\na,1\n", "has no row of b and 2 more; give one"),
    ],
)
def test_a_table_that_says_something_else_is_refused(text, what, tmp_path):
    with pytest.raises(ValueError, match=what):
        read_groupings(table(tmp_path / "g.csv", text), NAMES)


def test_several_data_sets_are_a_division_and_their_recordings_keep_apart(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        frames = tuple(rng.random((20, 12)) for _ in range(2))
        save_npz(tmp_path / name / f"{name}.npz", Recordings(frames, LAYOUT, names=("x", "y")))
    paths = [str(tmp_path / name) for name in ("one", "two")]
    log = open_recordings(paths)
    assert groupings_of(log, paths) == {"data set": [paths[0]] * 2 + [paths[1]] * 2}
    assert dividing(groupings_of(open_recordings(paths[:1]), paths[:1])) == {}
    assert len(set(Naming.of(log).recordings)) == 4


def contacts() -> list[np.ndarray]:
    """40 recordings, in the later half of which cell 7 is dead."""
    rng = np.random.default_rng(0)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 60)), 0)[:, None]
    frames = [
        0.1 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (60, 12)) for _ in range(40)
    ]
    for one in frames[20:]:
        one[:, 7] = 0.1
    return frames


def with_robots(path, frames):
    """Write recordings of two robots, the later half of the second one."""
    robots = ["ab"[i >= len(frames) // 2] for i in range(len(frames))]
    if path.suffix == ".h5":
        with pytest.importorskip("h5py").File(path, "w") as file:
            for i, (one, robot) in enumerate(zip(frames, robots, strict=True)):
                file[f"data/demo_{i}/tactile"] = one.reshape(-1, 3, 4)
                file[f"data/demo_{i}"].attrs["robot_id"] = robot
        return path
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    lengths = [len(one) for one in frames]
    columns = {
        "tactile": np.concatenate(frames).tolist(),
        "episode_index": np.repeat(np.arange(len(frames)), lengths),
        "robot": np.repeat(robots, lengths).tolist(),
    }
    parquet.write_table(pa.table(columns), path)
    return path


@pytest.mark.parametrize("ending", [".h5", ".parquet"])
def test_robots_that_a_file_states_are_a_division_whole_and_in_parts(ending, tmp_path, capsys):
    path = str(with_robots(tmp_path / f"set{ending}", contacts()))
    stated = ("--shape", "3x4", "--full-scale", "1")
    assert groupings_of(open_recordings(path, shape="3x4"), [path])["robot"] == [
        *"a" * 20,
        *"b" * 20,
    ]
    parts = [str(tmp_path / f"{i}.npz") for i in (1, 2, 3)]
    for i, part in enumerate(parts, 1):
        assert main(["check", path, *stated, "--shard", f"{i}/3", "--out", part, "--quiet"]) == 0
    capsys.readouterr()
    told = []
    for arguments in (["check", path, *stated, "--quick"], ["check", "--merge", *parts]):
        main([*arguments, "--quiet", "--json"])
        told.append(json.loads(capsys.readouterr().out))
    (reason,) = (one["reason"] for one in told[0]["findings"] if one["code"] == "TOUCH-160")
    assert "coincides with robot b and no other" in reason
    assert told[1]["findings"] == told[0]["findings"]


def test_check_tells_what_the_table_states(tmp_path, capsys):
    frames = contacts()
    (tmp_path / "set").mkdir()
    save_npz(tmp_path / "set/set.npz", Recordings(tuple(frames), LAYOUT))
    names = open_recordings(tmp_path / "set").names
    rows = [f'"{name}",{"ab"[i >= 20]}' for i, name in enumerate(names)]
    path = table(tmp_path / "g.csv", "\n".join(["recording,robot", *rows]))
    main(["check", str(tmp_path / "set"), "--groups", str(path), "--quiet", "--json"])
    told = json.loads(capsys.readouterr().out)
    reasons = [one["reason"] for one in told["findings"] if one["code"] == "TOUCH-160"]
    assert len(reasons) == 1
    assert "coincides with robot b and no other" in reasons[0]
    assert not any("coincides" in one["what"] for one in told["not_checked"])
    table(path, "recording,robot\n")
    assert main(["check", str(tmp_path / "set"), "--groups", str(path), "--quiet"]) == 3
    assert "is no table of groups" in capsys.readouterr().err
