"""A task that needs touch, in MuJoCo: python examples/mujoco_lift.py [--episodes 50]

The gripper of ``mujoco_gripper.py`` has to lift an object with just enough force. A fragile ball
breaks above 10 N; a heavy rod slips below 12 N and breaks above 30 N. The fingers are sent to a
position and do not say where they are. How wide the object is, where it lies and which of the two
it is has to be felt. A step takes 50 ms, and a policy gives for each step

- how far the fingers close, in units of ``FASTEST``;
- whether the fixture lets go of the object (above 0.5); it never holds it again.

An episode succeeds if the fixture has let go within ``PATIENCE`` steps, the object has slipped by
less than ``SLIP`` when the gripper has carried it for 0.4 s, and no pad has pressed harder than the
object stands.

``expert`` knows the object and the true force. Demonstrations disturb its actions and keep what it
would have done (DART: Laskey, Lee, Fox, Dragan and Goldberg 2017).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco_gripper import LAYOUT, MILLIMETRE, Floats, Object, loads, pose, scene

from diagnostics import Fault, inject

FASTEST = 0.7 * MILLIMETRE  # that the fingers close in a step
SERVO = 8000.0  # newtons a metre that the fingers are away from where they were sent
STRONGEST = 120.0  # newtons of the drive, for both fingers
TICKS = 10  # of the simulation in a step of 50 ms
PATIENCE = 36
CARRIED = 8  # steps that the object hangs in the gripper
SLIP = 4 * MILLIMETRE
FRAMES = 3  # of touch that a policy sees
HORIZON = 4  # steps of an action chunk
REPLAN = 1  # steps of a chunk that are carried out
NOISE = 0.004  # of a reading, as a share of full scale
STEPS = 4095  # of the converter
DISTURBED = 0.25  # standard deviation of what is added to how far the fingers close
GAIN = np.random.default_rng(0).lognormal(0, 0.1, LAYOUT.n_cells)  # of the cells of this sensor


@dataclass(frozen=True)
class Kind:
    """What a kind of object stands.

    Attributes:
        shape: a geom of MuJoCo.
        radius: least and largest, in millimetres.
        weight: newtons.
        firm, crushed: newtons of a pad below which it slips and above which it breaks.
    """

    shape: str
    radius: tuple[float, float]
    weight: float
    firm: float
    crushed: float

    @property
    def right(self) -> float:
        """The force to aim at: the geometric mean of both limits."""
        return float(np.sqrt(self.firm * self.crushed))


BALL = Kind("sphere", (9, 14), 2.0, 2.0, 10.0)
ROD = Kind("cylinder", (5, 9), 14.0, 12.0, 30.0)
KINDS = (BALL, ROD)


class Episode:
    """One object in the gripper.

    Args:
        seed: draws the object, how far the pads are away, and the noise of the readings.
        faults: of the sensor, from the start.
    """

    def __init__(self, seed: int, faults: Sequence[Fault] = ()) -> None:
        rng = np.random.default_rng([seed, 70])
        self.kind = KINDS[int(rng.integers(len(KINDS)))]
        radius = rng.uniform(*self.kind.radius)
        size = (radius,) if self.kind is BALL else (radius, 12.0)
        away = rng.uniform(-2, 4)
        turn = (rng.uniform(-90, 90), 0.0, 0.0)
        thing = Object(self.kind.shape, size, radius + away, turn=turn)
        self.model = scene(thing)
        # the fixture carries what the gripper does not, so that the weight alone can be set
        mass = self.model.body_mass[self.model.body("object").id]
        self.model.opt.gravity[2] = -self.kind.weight / mass
        self.data = mujoco.MjData(self.model)
        at, quaternion = pose(thing, rng)
        self.data.mocap_pos[0] = at
        self.data.mocap_quat[0] = quaternion
        self.data.qpos[2:] = np.concatenate([at, quaternion])
        self.rng = rng
        self.sent = 0.0
        self.force = 0.0
        self.hardest = 0.0
        self.step = 0
        self.let_go: int | None = None
        self.held_at = 0.0
        self.stuck = readings_of(faults, seed)
        self.touch = [self._read()] * FRAMES
        self.state = [self._told()] * FRAMES

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        if self.let_go is None:
            return self.step >= PATIENCE
        return self.step >= self.let_go + CARRIED

    @property
    def outcome(self) -> str:
        """ "lifted", "crushed", "dropped" or "not lifted"."""
        if self.hardest > self.kind.crushed:
            return "crushed"
        if self.let_go is None:
            return "not lifted"
        fallen = self.held_at - self._height()
        return "dropped" if fallen > SLIP else "lifted"

    def act(self, action: Floats) -> None:
        """Carry out an action ``[2]`` for one step."""
        closing = float(np.clip(action[0], -1, 1)) * FASTEST
        self.sent = float(np.clip(self.sent + closing, 0, 0.03))
        if action[1] > 0.5 and self.let_go is None:
            self.let_go = self.step
            self.held_at = self._height()
            self.data.eq_active[1] = 0
        for _ in range(TICKS):
            push = SERVO * (self.sent - self.data.qpos[0])
            self.data.ctrl[0] = np.clip(push, -STRONGEST, STRONGEST)
            mujoco.mj_step(self.model, self.data)
        pads = loads(self.data).reshape(2, -1).sum(axis=1)
        self.force = float(pads.mean())
        self.hardest = max(self.hardest, float(pads.max()))
        self.step += 1
        self.touch = [*self.touch[1:], self._read()]
        self.state = [*self.state[1:], self._told()]

    def expert(self) -> Floats:
        """Return the action ``[2]`` of one who knows the object and the force on it."""
        lacking = (self.kind.right - self.force) / self.kind.right
        closing = 1.0 if self.force < 0.1 else np.clip(2 * lacking, -1, 1)
        ready = abs(lacking) < 0.15 or self.let_go is not None
        return np.array([closing, float(ready)])

    def _height(self) -> float:
        return float(self.data.qpos[4])

    def _read(self) -> Floats:
        """Return the readings ``[D]`` in newtons, with the faults of this sensor."""
        share = loads(self.data) * GAIN / LAYOUT.full_scale
        share = share + self.rng.normal(0, NOISE, LAYOUT.n_cells)
        read = np.rint(np.clip(share, 0, 1) * STEPS) / STEPS * LAYOUT.full_scale
        return np.where(np.isnan(self.stuck[self.step]), read, self.stuck[self.step])

    def _told(self) -> Floats:
        """Return what the gripper says of itself: where it was sent, in centimetres, and whether
        the fixture has let go."""
        return np.array([100 * self.sent, float(self.let_go is not None)], np.float32)


@dataclass(frozen=True)
class Demonstration:
    """What the expert did with one object.

    Attributes:
        touch: readings in newtons, float32 ``[steps, D]``.
        state: what the gripper said, float32 ``[steps, 2]``.
        actions: of the expert, float32 ``[steps, 2]``.
    """

    touch: Floats
    state: Floats
    actions: Floats


def readings_of(faults: Sequence[Fault], seed: int) -> Floats:
    """Return what the faulty cells read in an episode, ``[steps, D]`` in newtons; NaN where a cell
    works. None of these faults depends on the load."""
    steps = PATIENCE + CARRIED + 1
    readings = inject(np.zeros((steps, LAYOUT.n_cells)), faults, LAYOUT, seed=seed)
    dead = np.zeros(LAYOUT.n_cells, bool)
    for fault in faults:
        dead[list(fault.cells)] = True
    return np.where(dead, readings, np.nan)


def demonstrate(seed: int, disturbance: float = DISTURBED) -> tuple[Demonstration, str]:
    """Return a demonstration and its outcome; ``disturbance``: standard deviation of what is added
    to how far the fingers close."""
    episode = Episode(seed)
    rng = np.random.default_rng([seed, 71])
    seen = []
    added = 0.0
    while not episode.over:
        action = episode.expert()
        seen.append((episode.touch[-1], episode.state[-1], action))
        added = 0.7 * added + disturbance * rng.normal()
        episode.act(action + np.array([added, 0.0]))
    columns = [np.asarray(column, np.float32) for column in zip(*seen, strict=True)]
    return Demonstration(*columns), episode.outcome


Policy = Callable[[Floats, Floats], Floats]


def rollouts(policy: Policy, seeds: Sequence[int], faults: Sequence[Fault] = ()) -> list[str]:
    """Return the outcome of an episode of each seed.

    Args:
        policy: maps touch ``[N, FRAMES, D]`` on the 0..1 scale and state ``[N, FRAMES, 2]`` to
            chunks of actions ``[N, HORIZON, 2]``.
        seeds: of the episodes.
        faults: of the sensor.
    """
    episodes = [Episode(seed, faults) for seed in seeds]
    while going := [episode for episode in episodes if not episode.over]:
        touch = np.stack([episode.touch for episode in going]) / LAYOUT.full_scale
        state = np.stack([episode.state for episode in going])
        chunks = policy(touch.astype(np.float32), state)
        for episode, chunk in zip(going, chunks, strict=True):
            for action in chunk[:REPLAN]:
                if not episode.over:
                    episode.act(action)
    return [episode.outcome for episode in episodes]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for disturbance in (0.0, DISTURBED):
        every = [demonstrate(args.seed + i, disturbance) for i in range(args.episodes)]
        outcomes = [outcome for _, outcome in every]
        steps = np.mean([len(shown.actions) for shown, _ in every])
        told = ", ".join(f"{outcomes.count(name)} {name}" for name in sorted(set(outcomes)))
        print(f"expert, disturbed by {disturbance}: {told}; {steps:.0f} steps on average")


if __name__ == "__main__":
    main()
