"""Frames of a running sensor for a policy: filled, marked, followed through maintenance, or
refused."""

import importlib.metadata
import time

import numpy as np
import pytest

import adaptfault.lerobot
from adaptfault.acquisition.followed import BundleAt
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.lerobot.limits import Limits, NotCertified
from adaptfault.lerobot.live import LiveTouch
from diagnostics import Fault, FaultKind, FaultSet

DEAD = (7, 31)


def deploy(bundle, cells) -> None:
    """Deploy a version that knows of these dead cells."""
    known = KnownFaults(bundle.layout.n_cells, (Fault(FaultKind.OPEN, tuple(cells)),))
    adaptation = bundle.parts.adapter().adapt(FaultSet(tuple(cells), 60), method="fill")
    bundle.deploy(bundle.write_version(adaptation, {"knowledge": known.to_dict()}).number)


@pytest.fixture
def live(bundle) -> LiveTouch:
    deploy(bundle, DEAD)
    return LiveTouch(BundleAt(bundle.path))


def whole(live, frames, given=None):
    frames = np.atleast_2d(frames).astype(float)
    return live(frames, np.ones(frames.shape, bool) if given is None else given)


def test_what_f_holds_is_filled_and_marked_and_all_else_stays_as_it_came(live, small_grasps):
    frames = np.array(small_grasps.frames[0][20:30], float)
    broken = frames.copy()
    broken[:, DEAD] = 5.0
    filled, valid, other = whole(live, broken)
    np.testing.assert_array_equal(np.delete(filled, DEAD, 1), np.delete(frames, DEAD, 1))
    assert np.flatnonzero(~valid[0]).tolist() == list(DEAD)
    np.testing.assert_array_equal(other, ~valid)
    error = np.abs(filled - frames)[:, DEAD]
    assert error.max() < 0.5 * np.abs(broken - frames)[:, DEAD].max()


def test_frames_of_a_batch_are_each_filled_as_if_they_came_alone(live, small_grasps):
    frames = np.array(small_grasps.frames[0][20:26], float)
    given = np.ones(frames.shape, bool)
    given[::2, 3] = False
    together = whole(live, frames, given)
    for i, frame in enumerate(frames):
        alone = live.__class__.__call__(live, np.stack([frame, frame]), given[[i, i]])
        for one, all_ in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one[0], all_[i])
    assert not together[1][0, 3]
    assert together[1][1, 3]


def test_a_version_that_is_deployed_takes_over_between_two_frames(bundle, live, small_grasps):
    frame = np.array(small_grasps.frames[0][20], float)
    assert (set(live.fault_set), live.version) == (set(DEAD), 2)
    deploy(bundle, (*DEAD, 40))
    whole(live, frame)
    live._follower.reload.thread.join()
    _, valid, _ = whole(live, frame)
    assert np.flatnonzero(~valid[0]).tolist() == [*DEAD, 40]
    assert live.version == 3


def test_cells_that_an_earlier_run_found_are_filled_too(live, small_grasps):
    live.remember(FaultSet((3,), 60))
    _, valid, _ = whole(live, small_grasps.frames[0][20])
    assert np.flatnonzero(~valid[0]).tolist() == [3, *DEAD]


def test_what_the_monitor_finds_is_filled_from_then_on(live, small_grasps, monkeypatch):
    frame = small_grasps.frames[0][20]
    found = Fault(FaultKind.STUCK, (3,), value=1.0, probability=1.0)
    monkeypatch.setattr(live._watch.monitor, "update", lambda frame, time: (found,))
    whole(live, np.stack([frame, frame]))
    assert live._monitoring is None  # a batch is not monitored
    _, valid, _ = whole(live, frame)
    assert valid[0, 3]
    while 3 not in live.fault_set:
        assert live._monitoring.is_alive()
        time.sleep(0.01)
    _, valid, _ = whole(live, frame)
    assert np.flatnonzero(~valid[0]).tolist() == [3, *DEAD]


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        (Limits(most_false_alarms=0.1), "the bundle has no bound of false alarms; ask"),
        (Limits(min_recall=0.99), r"must not act: min_recall is 0.99, and .*: recall "),
        (Limits(largest_error=1e-6), r"largest_error is 1e-06 N, and pad .* is filled with"),
    ],
)
def test_the_policy_does_not_act_beyond_a_limit(bundle, live, small_grasps, limits, told):
    refusing = LiveTouch(BundleAt(bundle.path), limits=limits)
    with pytest.raises(NotCertified, match=told) as error:
        whole(refusing, small_grasps.frames[0][20])
    assert "\n" not in str(error.value)


def test_it_acts_within_its_limits_until_more_cells_are_found(bundle, live, small_grasps):
    acting = LiveTouch(BundleAt(bundle.path), limits=Limits(min_recall=1e-6, largest_error=5.0))
    whole(acting, small_grasps.frames[0][20])
    acting.remember(FaultSet((3,), 60))
    with pytest.raises(NotCertified, match="1 cells were found faulty since version 2"):
        whole(acting, small_grasps.frames[0][20])


@pytest.mark.parametrize("limit", [0.0, -1.0, 1.5, float("nan")])
def test_a_limit_that_is_no_share_is_refused(limit):
    for name in ("most_false_alarms", "min_recall"):
        with pytest.raises(ValueError, match=f"{name}={limit}: expected a share"):
            Limits(**{name: limit})


def test_another_lerobot_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr(adaptfault.lerobot, "version", lambda name: "0.5.0")
    with pytest.raises(ImportError, match=r"written for LeRobot 0.4.4, and 0.5.0 is installed"):
        _ = adaptfault.lerobot.TouchProcessorStep

    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(adaptfault.lerobot, "version", missing)
    with pytest.raises(ImportError, match="needs LeRobot, which is not installed: pip install"):
        _ = adaptfault.lerobot.TouchProcessorStep
