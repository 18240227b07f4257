"""Maintenance of one robot on one thread; every error becomes an outcome."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from adaptfault.bundle.lock import Busy
from adaptfault.fleet.listing import Robot
from adaptfault.fleet.outcome import Outcome

# s to wait for a robot that another process maintains, and between two attempts
_PATIENCE = 120
_PAUSE = 0.5


def ready() -> None:
    """Import what maintenance needs (the import of this module does it)."""


def maintain_robot(
    robot: Robot,
    *,
    dry_run: bool = False,
    budget: float | None = None,
    keys: Sequence[str] | None = None,
    least_serial: int = 0,
    sign: str | None = None,
) -> Outcome:
    """Maintain one robot; a failure becomes an outcome "error" with its reason.

    Args:
        robot: with paths that are valid on every worker.
        dry_run: report only.
        budget: seconds that an adaptation may take.
        keys, least_serial: whose signature the bundle needs, see :class:`Bundle`.
        sign: PEM file of the private key that signs the bundle after the run; None: it is not
            signed.
    """
    whose = {"keys": keys, "least_serial": least_serial}
    how = {"dry_run": dry_run, "budget": budget, "sign": sign}
    work = partial(_maintained, robot, whose, how)
    began = time.perf_counter()
    try:
        with _one_thread():
            return _patiently(work, began)
    except (ValueError, OSError) as error:
        return Outcome.error(robot, str(error), time.perf_counter() - began)
    except Exception as error:  # one robot must not stop the others
        return Outcome.error(robot, f"{type(error).__name__}: {error}", time.perf_counter() - began)


def _patiently(work: Callable[[float], Outcome], began: float) -> Outcome:
    """Wait for a locked robot: a Dask worker may still process it after its run was killed."""
    while True:
        try:
            return work(began)
        except Busy:
            if time.perf_counter() - began > _PATIENCE:
                raise
        time.sleep(_PAUSE)


def _maintained(
    robot: Robot, whose: Mapping[str, Any], how: Mapping[str, Any], began: float
) -> Outcome:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.maintenance import maintain
    from adaptfault.robot.new_recordings import load_new_recordings

    bundle = Bundle.open(robot.bundle, **whose)
    incoming = load_new_recordings(bundle, robot.paths())
    report = maintain(bundle, incoming.frames, names=incoming.names, scan=incoming.scan, **how)
    notes = tuple(problem.message for problem in incoming.problems if problem.level == "error")
    return Outcome.of(robot, bundle, report, notes=notes, seconds=time.perf_counter() - began)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit numeric libraries to one thread, because there are as many workers as cores."""
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)
