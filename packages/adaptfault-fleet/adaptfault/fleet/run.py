"""Maintains a fleet on worker processes; each outcome is stored at once, so that a killed run
resumes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from adaptfault.bundle.journal import now
from adaptfault.bundle.lock import locked
from adaptfault.data.documents import rebuilt
from adaptfault.data.json_lines import Lines
from adaptfault.fleet.engines import Engine, engine
from adaptfault.fleet.guard import Task
from adaptfault.fleet.listing import Fleet, Robot
from adaptfault.fleet.outcome import NAMES, Outcome
from adaptfault.fleet.work import maintain_robot, ready

if TYPE_CHECKING:
    from adaptfault.fleet.summary import FleetReport

SCHEMA = "adaptfault.fleet-ledger/1"
LEDGER = "ledger.jsonl"

# a run without progress for longer is not resumed, because the robots have recorded since
_OVER = timedelta(hours=12)


def maintain_fleet(
    fleet: Fleet,
    folder: str | Path,
    *,
    jobs: int | None = None,
    dask: str | None = None,
    dry_run: bool = False,
    budget: float | None = None,
    limit: float | None = None,
    keys: Sequence[str] | None = None,
    least_serial: int = 0,
    sign: str | None = None,
    progress: bool | None = None,
) -> FleetReport:
    """Run ``maintain`` over all robots; one that fails is an error in the report, and the others go
    on.

    Each outcome is appended to ``folder/ledger.jsonl``. Called again after a kill with the same
    options, it processes the remaining robots; after a run that ended, or without progress for 12
    hours, it starts a new run.

    Args:
        fleet: the robots. Their paths must be valid on every worker (a shared folder, with Dask).
        folder: of the run; created where missing.
        jobs: worker processes on this machine, one thread each; None: as many as cores.
        dask: address of a Dask scheduler whose workers are used instead, as "tcp://host:8786".
        dry_run: report only, change nothing.
        budget: seconds that one adaptation may take.
        limit: seconds per robot, after which its process is killed and the robot is an error. None:
            no limit.
        keys, least_serial: whose signature each bundle needs, see :class:`Bundle`. The files must
            be there on every worker.
        sign: PEM file of the private key that signs each bundle after its run, with ``keys``; None:
            none is signed.
        progress: show or hide it on stderr; None shows it on a terminal.

    Raises:
        ValueError: ``jobs`` is below 1 or given with ``dask``, ``limit`` is not above 0, Dask is
            not installed, the ledger has another schema, or ``sign`` comes without ``keys``.
        Busy: another process maintains the fleet in this folder.
        OSError: the scheduler does not answer.
    """
    from adaptfault.fleet.summary import FleetReport

    _check(jobs, dask, limit, keys, sign)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {
        "dry_run": dry_run,
        "budget": budget,
        "least_serial": least_serial,
        "sign": sign,
        "keys": None if keys is None else list(map(str, keys)),
    }
    task = Task(partial(maintain_robot, **options), ready, limit)
    with locked(folder / "run.lock", patience=0):
        workers = engine(task, jobs=jobs, dask=dask)
        began, outcomes = _outcomes(fleet, Lines(folder / LEDGER), options, workers, progress)
    return FleetReport(outcomes, began, now(), dry_run, fleet.source)


def _check(
    jobs: int | None,
    dask: str | None,
    limit: float | None,
    keys: Sequence[str] | None,
    sign: str | None,
) -> None:
    if limit is not None and not limit > 0:
        raise ValueError(f"limit {limit}: expected seconds, more than 0")
    if sign is not None and not keys:  # whatever lies in the bundle would be signed
        raise ValueError("sign needs keys: only a bundle that a trusted key signed is signed again")
    if jobs is not None and (jobs < 1 or dask is not None):
        raise ValueError(
            f"jobs {jobs}: expected at least 1, and none with a Dask cluster, which has its own"
            " workers"
        )


def _outcomes(
    fleet: Fleet,
    lines: Lines,
    options: dict[str, Any],
    workers: AbstractContextManager[Engine],
    progress: bool | None,
) -> tuple[str, tuple[Outcome, ...]]:
    """Return when the run began, and the outcome of each robot, those of a run that is resumed
    among them."""
    began, done = _resumed(lines, fleet, options)
    if not done:
        began = now()
        lines.begin({"schema": SCHEMA, "options": options, "began": began})
    left = [robot for robot in fleet.robots if robot.name not in done]
    hide = None if progress is None else not progress
    with workers as work:
        for outcome in tqdm(
            work(left), total=len(fleet), initial=len(done), unit="robot", disable=hide
        ):
            lines.add({"time": now(), "outcome": outcome.to_dict()})
            done[outcome.robot.name] = outcome
    lines.add({"time": now(), "ended": True})
    return began, tuple(done[robot.name] for robot in fleet.robots)


@dataclass(frozen=True)
class _Head:
    """The first line of a ledger: the options and the begin of the run."""

    options: dict  # type: ignore[type-arg]  # of any content
    began: str


@dataclass(frozen=True)
class _Entry:
    """A further line: the outcome of a robot, or the end of the run."""

    time: str
    outcome: Outcome | None = None
    ended: bool = False

    def __post_init__(self) -> None:
        if (self.outcome is None) != self.ended:
            raise ValueError("expected an outcome, or the end")


def _resumed(lines: Lines, fleet: Fleet, options: dict[str, Any]) -> tuple[str, dict[str, Outcome]]:
    """Return the start and the outcomes of the run in the ledger; empty if a new run is due.

    Raises:
        ValueError: the file is no ledger, or a line of it is damaged.
    """
    documents = lines.read()
    if not documents:
        return "", {}
    number = 1
    try:
        head = rebuilt(documents[0], _Head, schema=SCHEMA)
        last = _time(head.began)
        entries = []
        for document in documents[1:]:
            number += 1
            entries.append(rebuilt(document, _Entry, NAMES))
            last = _time(entries[-1].time)
    except ValueError as error:
        what = f"no line of a ledger ({error}); remove the file, or give another --out"
        raise ValueError(f"{lines.path}, line {number}: {what}") from None
    over = any(entry.ended for entry in entries)
    if over or head.options != options or datetime.now(timezone.utc) - last > _OVER:
        return "", {}
    # A robot whose paths changed is processed again.
    listed = {_identity(robot): robot for robot in fleet.robots}
    done = {}
    for entry in entries:
        robot = None if entry.outcome is None else listed.get(_identity(entry.outcome.robot))
        if entry.outcome is not None and robot is not None:
            done[robot.name] = replace(entry.outcome, robot=robot)
    return head.began, done


def _time(text: str) -> datetime:
    """Return a time with its zone; raises ValueError."""
    time = datetime.fromisoformat(text)
    if time.tzinfo is None:
        raise ValueError(f"expected a time with its zone, got {text!r}")
    return time


def _identity(robot: Robot) -> str:
    return json.dumps([robot.name, robot.bundle, robot.recordings])
