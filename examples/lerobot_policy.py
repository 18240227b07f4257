"""ACT of LeRobot, repaired after cells die: python examples/lerobot_policy.py [--quick]

Needs ``lerobot==0.4.4``, which wants a torch of its own: an environment beside. ACT gets touch as
the state of the environment and an earlier grip as the state of the robot. Its actions are the
forces of both pads in the next frames of simulated grasps. Printed is R2 of the actions on grasps
that no training has seen.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACT
from numpy.typing import NDArray
from torch import Tensor, nn

import adaptfault as af
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(2, 6, 5)
CHUNK = (4, 2)  # steps, pads
FRAMES = 3
DEAD = 12
STATE = "observation.state"


class Chunks(nn.Module):
    """ACT from touch ``[N, FRAMES, D]`` and state ``[N, FRAMES, 2]`` to its actions alone."""

    def __init__(self, act: ACT) -> None:
        super().__init__()
        self.act = act

    def forward(self, touch: Tensor, **others: Tensor) -> Tensor:
        """Return chunks of actions ``[N, 4, 2]``."""
        state = others[STATE][:, -1]
        return self.act({"observation.environment_state": touch.flatten(1), STATE: state})[0]


def small_act() -> ACT:
    """Return an untrained ACT without its latent variable."""
    touch = PolicyFeature(FeatureType.ENV, (FRAMES * LAYOUT.n_cells,))
    state = PolicyFeature(FeatureType.STATE, (2,))
    return ACT(
        ACTConfig(
            input_features={"observation.environment_state": touch, STATE: state},
            output_features={"action": PolicyFeature(FeatureType.ACTION, (CHUNK[1],))},
            chunk_size=CHUNK[0],
            n_action_steps=CHUNK[0],
            dim_model=64,
            n_heads=4,
            dim_feedforward=128,
            n_encoder_layers=1,
            use_vae=False,
            dropout=0.0,
        )
    )


def next_forces(frames: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the forces of both pads in the frames after each, ``[T, 4, 2]``, in 10 N."""
    pads = frames.reshape(len(frames), 2, -1).sum(axis=2) / 10
    longer = np.concatenate([pads, np.repeat(pads[-1:], CHUNK[0], axis=0)])
    return np.stack([longer[1 + i : 1 + i + len(pads)] for i in range(CHUNK[0])], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two epochs")
    args = parser.parse_args()
    grasps = af.simulate(40, LAYOUT, n_frames=60, seed=0, classes=("softer", "harder"))
    actions = [next_forces(frames) for frames in grasps.frames]
    grip = [np.roll(next_forces(frames)[:, 0], 2, axis=0) for frames in grasps.frames]
    windows = af.make_windows(
        grasps.frames, actions, LAYOUT, length=FRAMES, stride=2, extra={STATE: grip}
    )
    training, validation, test = af.split(windows)
    torch.manual_seed(0)
    policy = Chunks(small_act())
    epochs = 2 if args.quick else 40
    af.train(policy, training, validation, epochs=epochs, learning_rate=1e-3, progress=False)
    dead = np.random.default_rng(0).choice(LAYOUT.n_cells, DEAD, replace=False)
    faults = FaultSet(tuple(sorted(dead.tolist())), LAYOUT.n_cells)
    x = test.x.copy()
    x[..., faults.mask] = 1.0
    broken = replace(test, x=x)
    print(f"{DEAD} of {LAYOUT.n_cells} cells at full scale")
    print("without faults:", f"R2 {af.evaluate(policy, test).r2:.3f}")
    print("nothing done:  ", f"R2 {af.evaluate(policy, broken).r2:.3f}")
    adapter = af.Adapter(policy, training, validation, layout=LAYOUT)
    for method in ("fill", "head", "finetune"):
        adapted = adapter.adapt(faults, method=method, progress=False)
        print(f"{method + ':':15}", f"R2 {af.evaluate(adapted, broken).r2:.3f}")


if __name__ == "__main__":
    main()
