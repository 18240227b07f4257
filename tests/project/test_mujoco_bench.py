"""The gripper in MuJoCo obeys the laws that it states, and its damages break what they name."""

import numpy as np
import pytest

from diagnostics import FaultSet

mujoco = pytest.importorskip("mujoco")
mujoco_gripper = pytest.importorskip("mujoco_gripper")
mujoco_bench = pytest.importorskip("mujoco_bench")
CELL = mujoco_gripper.CELL
LAYOUT = mujoco_gripper.LAYOUT


@pytest.mark.parametrize("name", ["small ball", "soft ball", "disc"])
def test_a_dome_in_series_with_the_object_is_a_spring_of_the_stated_stiffness(name: str):
    thing = mujoco_gripper.OBJECTS[name]
    model = mujoco_gripper.scene(thing)
    data = mujoco.MjData(model)
    data.ctrl[0] = 2 * 20.0
    mujoco.mj_step(model, data, 300)
    depth = -data.contact.dist
    force = data.efc_force[data.contact.efc_address]
    series = 1 / (1 / CELL + 1 / thing.stiffness)
    assert len(depth) > 8
    np.testing.assert_allclose(force, series * depth, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("name", ["plate", "rod"])
def test_an_object_that_is_held_loads_both_pads_alike_with_the_grip_force(name: str):
    pads = mujoco_gripper.grasp(name, seed=3).reshape(60, 2, -1).sum(axis=2)
    held = np.r_[10:30, 40:60]
    assert (pads[held] > 14).all()
    assert (pads[held] < 45).all()
    np.testing.assert_allclose(pads[held, 0], pads[held, 1], rtol=0.06)
    assert not pads[0].any()  # still open


def test_a_slip_moves_the_load_along_the_pads():
    def centre(seed: int) -> np.ndarray:
        forces = mujoco_gripper.grasp("small ball", seed)[10:28, : LAYOUT.n_cells // 2]
        places = np.array([mujoco_gripper.place(cell) for cell in range(forces.shape[1])])
        return forces @ places / forces.sum(axis=1, keepdims=True)

    way = [np.ptp(centre(seed), axis=0).max() / mujoco_gripper.PITCH for seed in range(6)]
    assert min(way) < 0.3  # held still
    assert max(way) > 0.7


def test_grasps_are_the_same_for_the_same_seed_only():
    first = mujoco_gripper.grasp("pen", seed=1)
    assert first.shape == (60, LAYOUT.n_cells)
    np.testing.assert_array_equal(first, mujoco_gripper.grasp("pen", seed=1))
    assert np.abs(first - mujoco_gripper.grasp("pen", seed=2)).max() > 0.5


def test_facing_cells_carry_the_same_of_a_plate():
    """The two pads see a flat object from both sides: their columns are mirrored."""
    for cell in range(LAYOUT.n_cells // 2):
        pad, row, col = LAYOUT.position(cell)
        facing = LAYOUT.cell(1 - pad, row, LAYOUT.cols - 1 - col)
        assert mujoco_gripper.place(cell) == pytest.approx(mujoco_gripper.place(facing))


def faulty(damage: "mujoco_bench.Damage") -> FaultSet:
    cells = np.flatnonzero(damage.errors() > mujoco_bench.FAULTY)
    return FaultSet(tuple(cells.tolist()), LAYOUT.n_cells)


def test_each_damage_breaks_the_cells_that_it_names():
    life = [np.eye(LAYOUT.n_cells)[[5]]]  # one cell does all the work
    nothing, short, knife, cable, wear, drop = mujoco_bench.damages(life)
    assert not nothing.errors().any()
    assert faulty(short) >= FaultSet((LAYOUT.cell(0, 6, 4),), LAYOUT.n_cells)
    severed = [LAYOUT.cell(0, r, c) for r in range(5) for c in range(7 - r, LAYOUT.cols)]
    assert faulty(knife) == FaultSet(tuple(severed), LAYOUT.n_cells)
    row = [LAYOUT.cell(1, 5, c) for c in range(LAYOUT.cols)]
    assert faulty(cable) == FaultSet(tuple(row), LAYOUT.n_cells)
    assert faulty(wear) == FaultSet((5,), LAYOUT.n_cells)
    assert {LAYOUT.position(cell)[0] for cell in faulty(drop)} == {1}
    assert len(faulty(drop)) > 8


def test_a_cable_opens_while_its_pad_is_loaded_and_closes_again():
    cable = mujoco_bench.damages([np.ones((1, LAYOUT.n_cells))])[3]
    row = [LAYOUT.cell(1, 5, c) for c in range(LAYOUT.cols)]
    forces = np.full((3, LAYOUT.n_cells), 0.1)
    forces[1] = 1.0
    readings = cable.read(forces, seed=0)[:, row]
    assert (readings[[0, 2]] > 0.05).all()
    assert (readings[1] < 0.05).all()


def test_wear_grows_with_age():
    wear = mujoco_bench.damages([np.ones((1, LAYOUT.n_cells))])[4]
    forces = np.ones((1, LAYOUT.n_cells))
    young, old = (wear.read(forces, seed=0, age=age).mean() for age in (0.0, 1.0))
    assert old == pytest.approx(young / 4, rel=0.05)
