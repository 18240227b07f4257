"""The task that needs touch, and what its table says."""

import numpy as np
import pytest
import torch

mujoco = pytest.importorskip("mujoco")
mujoco_lift = pytest.importorskip("mujoco_lift")
mujoco_policy = pytest.importorskip("mujoco_policy")
D = mujoco_lift.LAYOUT.n_cells


def test_the_expert_lifts_both_kinds_of_objects_and_a_seed_gives_the_same_episode():
    kinds = set()
    for seed in (2, 3, 4, 5):
        shown, outcome = mujoco_lift.demonstrate(seed, 0.0)
        again, _ = mujoco_lift.demonstrate(seed, 0.0)
        np.testing.assert_array_equal(again.touch, shown.touch)
        assert outcome == "lifted"
        kinds.add(mujoco_lift.Episode(seed).kind)
    assert kinds == set(mujoco_lift.KINDS)


@pytest.mark.parametrize(("closing", "outcome"), [(1.0, "crushed"), (0.0, "dropped")])
def test_an_object_breaks_in_a_closing_gripper_and_falls_from_an_open_one(closing, outcome):
    def policy(touch, state):
        return np.tile([closing, 1.0 if closing == 0 else 0.0], (len(touch), 4, 1))

    assert set(mujoco_lift.rollouts(policy, range(3))) == {outcome}


def test_dead_cells_read_what_the_fault_says_and_others_what_they_feel():
    for damage in mujoco_policy.damages(0):
        seen = []

        def policy(touch, state, seen=seen):
            seen.append(touch[0, -1])
            return np.tile([1.0, 0.0], (len(touch), 4, 1))

        mujoco_lift.rollouts(policy, [3], damage.faults)
        broken = np.array(seen)
        seen.clear()
        mujoco_lift.rollouts(policy, [3])
        healthy = np.array(seen)
        alive = damage.cells.healthy
        np.testing.assert_array_equal(broken[:, alive], healthy[:, alive])
        assert (broken[:, damage.cells.mask] != healthy[:, damage.cells.mask]).mean() > 0.3
        assert len(damage.cells) in (10, D // 10, D // 2)


def test_a_masked_cell_may_read_anything_and_its_token_is_learnt():
    torch.manual_seed(0)
    policy = mujoco_policy.Act(masks=True)
    touch = torch.rand(2, mujoco_lift.FRAMES, D)
    state = torch.rand(2, mujoco_lift.FRAMES, 2)
    touch[..., 7] = torch.nan
    actions = policy(touch, state)
    assert torch.isfinite(actions).all()
    actions.sum().backward()
    token = policy.see[0].weight.grad[:, D + 7]
    assert (token != 0).any()


def test_masks_leave_half_of_a_batch_whole():
    x = torch.zeros(64, 3, D)
    masked = mujoco_policy.RandomMasks()(x, torch.Generator().manual_seed(0)).isnan()
    assert not masked[32:].any()
    assert masked[:32].any()
    assert not masked.all(dim=2).any()


def test_the_table_has_wilsons_intervals():
    row = mujoco_policy.Row(0, "none", "fill", 0.0, ("lifted",) * 45 + ("dropped",) * 5)
    assert mujoco_policy.success([row]) == pytest.approx((0.9, 0.7864, 0.9565), abs=1e-4)
    assert "| 0.90 (0.79 to 0.96) |" in mujoco_policy.table([row])


def test_the_table_tells_each_seed_beside_the_rate_over_all():
    rows = [
        mujoco_policy.Row(seed, "none", "fill", 0.0, ("lifted",) * n + ("dropped",) * (50 - n))
        for seed, n in enumerate((45, 35))
    ]
    assert "| 0.80 (0.71 to 0.87): 0.90, 0.70 |" in mujoco_policy.table(rows)
