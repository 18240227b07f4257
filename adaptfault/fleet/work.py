"""What a worker does: maintain one robot on one thread, whatever is wrong with it, and say in short how it went."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Outcome
from adaptfault.robot.lock import Busy

_PATIENCE, _PAUSE = 120, 0.5  # s to wait for a robot that another process maintains, and between two tries


def ready() -> None:
    """Load what maintenance needs."""


def maintain_robot(robot: Robot, *, dry_run: bool = False, budget: float | None = None) -> Outcome:
    """Maintain one robot; the outcome of one that cannot be is an error with its reason.

    Args:
        robot: paths, which must mean the same on every worker.
        dry_run: report only.
        budget: seconds that an adaptation may take.
    """
    began = time.perf_counter()
    try:
        with _one_thread():
            return _patiently(robot, dry_run, budget, began)
    except (ValueError, OSError) as error:
        return Outcome.error(robot, str(error), time.perf_counter() - began)
    except Exception as error:  # one robot never ends the night of all the others
        return Outcome.error(robot, f"{type(error).__name__}: {error}", time.perf_counter() - began)


def _patiently(robot: Robot, dry_run: bool, budget: float | None, began: float) -> Outcome:
    """Wait for a robot that is being maintained: a Dask worker goes on with it for a while after its run was killed."""
    while True:
        try:
            return _maintained(robot, dry_run, budget, began)
        except Busy:
            if time.perf_counter() - began > _PATIENCE:
                raise
        time.sleep(_PAUSE)


def _maintained(robot: Robot, dry_run: bool, budget: float | None, began: float) -> Outcome:
    from adaptfault.robot.bundle import Bundle
    from adaptfault.robot.maintenance import maintain
    from adaptfault.robot.new_recordings import load_incoming

    bundle = Bundle.open(robot.bundle)
    incoming = load_incoming(bundle, robot.paths())
    report = maintain(bundle, incoming.frames, names=incoming.names, dry_run=dry_run, budget=budget)
    notes = tuple(problem.message for problem in incoming.problems if problem.level == "error")
    return Outcome.of(robot, bundle, report, notes=notes, seconds=time.perf_counter() - began)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Workers are as many as cores: threads within each would only wait for each other."""
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)
