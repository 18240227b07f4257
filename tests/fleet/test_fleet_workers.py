"""Robots that crash, hang or raise on the workers of a fleet, and runs that are killed."""

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from adaptfault.fleet.engines import engine
from adaptfault.fleet.guard import Task
from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Outcome


def robots(*names: str) -> list[Robot]:
    return [Robot(name, f"/{name}/robot.bundle", (f"/{name}/log",)) for name in names]


def work() -> Callable[[Robot], Outcome]:
    """What robots do, by name; made here, so that workers need not import this file."""
    import os
    import signal
    import sys
    import time

    def done(robot: Robot) -> Outcome:
        if robot.name == "crash":
            os._exit(1)
        if robot.name == "killer":  # takes the Dask worker with it, which is its process's parent
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(60)
        if robot.name == "hang":
            time.sleep(60)
        if robot.name == "exit":
            raise SystemExit(3)
        if robot.name == "greedy":  # loky replaces a process that grew by 300 MB
            time.sleep(1.1)
            sys.kept = b"x" * 400_000_000
        return Outcome(robot, "unchanged", 0, f"by {os.getpid()}", 1, 60, 0, "2 x 6 x 5")

    return done


def done(
    names: str, *, limit: float | None = None, jobs: int | None = None, dask: str | None = None
) -> dict:
    """Name to outcome."""
    with engine(Task(work(), int, limit), jobs=jobs, dask=dask) as workers:
        outcomes = list(workers(robots(*names.split())))
    assert sorted(o.robot.name for o in outcomes) == sorted(names.split())
    return {o.robot.name: o for o in outcomes}


def errors(outcomes: dict) -> dict[str, str]:
    return {name: o.reason for name, o in outcomes.items() if o.decision == "error"}


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Two Dask workers under nannies, on loopback; what was on a worker that died is tried alone,
    once."""
    distributed = pytest.importorskip("distributed")
    import dask

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as started,
    ):
        yield started.scheduler_address


@pytest.fixture(params=["loky", pytest.param("dask", marks=pytest.mark.slow)])
def where(request) -> dict:
    return {"jobs": 2} if request.param == "loky" else {"dask": request.getfixturevalue("cluster")}


def test_a_robot_that_crashes_hangs_or_exits_is_an_error_and_the_others_go_on(where):
    found = errors(done("a crash b hang c exit d", limit=1.5, **where))
    assert set(found) == {"crash", "hang", "exit"}
    assert "the process that maintained it died" in found["crash"]
    assert "not finished after 1.5 s" in found["hang"]
    assert found["exit"] == "SystemExit: 3"


def test_a_robot_that_crashes_is_an_error_with_one_worker_too():
    assert set(errors(done("a crash b", jobs=1))) == {"crash"}


def test_an_address_without_a_port_is_refused_at_once():
    pytest.importorskip("distributed")
    with (
        pytest.raises(ValueError, match="'bad': expected the address"),
        engine(Task(work(), int), jobs=None, dask="bad"),
    ):
        pass


@pytest.mark.slow
def test_a_robot_that_kills_a_dask_worker_stops_no_other(cluster):
    found = errors(done("a b killer c d", dask=cluster))
    assert set(found) == {"killer"}, found
    assert "every Dask worker that processed it died" in found["killer"]


def test_two_workers_work_at_the_same_time(where, tmp_path):
    def meet(robot: Robot) -> Outcome:
        """Wait for the other robot."""
        import time

        (tmp_path / robot.name).touch()
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        return Outcome(robot, "unchanged", 0, "met", 1, 60, 0, "2 x 6 x 5")

    with engine(Task(meet, int, 300), **{"jobs": None, "dask": None, **where}) as workers:
        assert [o.reason for o in workers(robots("a", "b"))] == ["met", "met"]


def test_processes_go_on_from_robot_to_robot():
    assert len({o.reason for o in done("a b c d e f", jobs=2).values()}) <= 2


@pytest.mark.slow
def test_a_process_that_grew_is_replaced_and_its_warning_is_no_error():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = done("a greedy b c", jobs=1)
    assert not errors(found)
    assert found["a"].reason == found["greedy"].reason != found["c"].reason


@pytest.mark.slow
def test_a_cluster_that_is_restarted_ends_the_run_without_an_outcome(cluster):
    import distributed

    with engine(Task(work(), int), jobs=None, dask=cluster) as workers:
        outcomes = workers(robots("a", "hang"))
        assert next(outcomes).robot.name == "a"
        with distributed.Client(cluster, set_as_default=False) as other:
            # to wait is no part of it, and takes minutes on a busy machine
            other.restart(wait_for_workers=False)
        with pytest.raises(OSError, match="went away"):
            next(outcomes)


# A run that is killed, with work that leaves a mark and takes its time.

_RUN = """
import adaptfault.fleet.run as running
from adaptfault.fleet.listing import Fleet
from adaptfault.fleet.outcome import Outcome

def work(robot, **options):
    import fcntl, time
    from pathlib import Path
    with open(robot.bundle, "a") as lock:
        # as a bundle's: an orphan that goes on would hold it
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(0.4)
        with open(Path(robot.bundle).parent / "marks", "a") as marks:
            marks.write(robot.name + "\\n")
    return Outcome(robot, "unchanged", 0, "no faulty cell", 1, 60, 0, "2 x 6 x 5")

running.maintain_robot, running.ready = work, int
print(running.maintain_fleet(Fleet.read("fleet.toml"), "run", jobs=2, progress=False))
"""


@pytest.fixture
def killed(tmp_path: Path) -> Callable[[], subprocess.Popen]:
    """Starts a run over ten robots; its output goes to a file, which a process left over cannot
    hold open."""
    listed = [
        f'[[robots]]\nname = "r{i}"\nbundle = "r{i}"\nrecordings = "log"\n' for i in range(10)
    ]
    (tmp_path / "fleet.toml").write_text("".join(listed))
    (tmp_path / "run.py").write_text(_RUN)

    def start() -> subprocess.Popen:
        with (tmp_path / "told").open("w") as told:
            return subprocess.Popen(
                [sys.executable, "run.py"], cwd=tmp_path, stdout=told, stderr=subprocess.STDOUT
            )

    return start


def ledger(folder: Path) -> list[str]:
    path = folder / "run" / "ledger.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [
        entry["outcome"]["robot"]["name"] for entry in map(json.loads, lines) if "outcome" in entry
    ]


def until(true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGINT], ids=["kill -9", "Ctrl-C"])
def test_a_run_that_is_killed_half_way_is_completed_and_redoes_nothing_finished(
    killed, tmp_path, kill
):
    process = killed()
    until(lambda: len(ledger(tmp_path)) >= 4)
    os.kill(process.pid, kill)
    process.wait(timeout=60)
    finished = ledger(tmp_path)
    assert 4 <= len(finished) < 10
    assert killed().wait(timeout=120) == 0
    told = (tmp_path / "told").read_text()
    assert "10 robots: 10 ok" in told, told
    marks = (tmp_path / "marks").read_text().split()
    assert sorted(set(marks)) == [f"r{i}" for i in range(10)]
    assert all(marks.count(name) == 1 for name in finished)
