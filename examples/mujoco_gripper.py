"""Grasps of a gripper in MuJoCo: python examples/mujoco_gripper.py [--grasps 24] [--out FILE.npz]

Two opposing pads of 11 x 10 cells close on twelve objects: balls, boxes, cylinders, a capsule,
ellipsoids, some of them soft. Contact, friction and motion are MuJoCo's (``pip install
'adaptfault-bench[mujoco]'``). Its own sensors do not give newtons a cell: ``touch_grid`` sorts
contact points into angles, and ``tactile`` gives depths at the vertices of a mesh. A cell is
therefore a dome of its own on the pad, and reads the normal force that the solver puts on it.

- A dome is a spring of ``CELL`` newtons a metre, in series with that of the object.
- The pads are coupled, and driven by one force, which rises to the grip force and trembles.
- A fixture (a weld) holds the object until the pads have closed, then lets go.
- In half of the holds the fixture pulls the object a few millimetres along the pads: it slips.
- Halfway the gripper opens and grasps the object again, in another pose.

A recording has 60 frames at 10 Hz. ``read`` is the electrical side: gains of the cells, noise and
the resistor network of :mod:`diagnostics.simulation.circuit` with a converter of 12 bits.

Not modelled: cells that couple through the skin, hysteresis and relaxation, a pad that bends.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from adaptfault import Recordings, save_npz
from diagnostics import SensorLayout
from diagnostics.simulation.circuit import Circuit

LAYOUT = SensorLayout.paper()
PITCH = 0.0034  # metres between cells
DOME = 0.004  # radius of a cell's dome: more than half the pitch, so that they overlap
CELL = 2000.0  # newtons a metre
TIMESTEP = 0.005
HELD = 300  # frames of 10 ms: a recording is two grasps of 3 s
CLOSING = (20, 80)  # the pads start to close, and the fixture lets go, in frames of 10 ms
APPROACH = 4.0  # newtons while the pads travel
MILLIMETRE = 1e-3

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Object:
    """A rigid body with one spring a contact.

    Attributes:
        shape: a geom of MuJoCo.
        size: its size in millimetres, as MuJoCo takes it.
        half: half its width between the pads, in millimetres.
        turn: its rotation in degrees about x (from pad to pad), y (along a row) and z (up).
        stiffness: of its surface, newtons a metre and cell.
        friction: of its surface on the pads.
    """

    shape: str
    size: tuple[float, ...]
    half: float
    turn: tuple[float, float, float] = (0, 0, 0)
    stiffness: float = 5e4
    friction: float = 0.7


OBJECTS = {
    "small ball": Object("sphere", (9,), 9),
    "large ball": Object("sphere", (22,), 22),
    "soft ball": Object("sphere", (22,), 22, stiffness=600, friction=1.0),
    "cube": Object("box", (10, 10, 10), 10),
    "plate": Object("box", (4, 14, 16), 4, friction=0.4),
    "soft block": Object("box", (12, 14, 16), 12, stiffness=400, friction=1.0),
    "edge": Object("box", (10, 10, 15), 14.1, turn=(0, 0, 45)),
    "rod": Object("cylinder", (7, 25), 7, friction=0.5),
    "disc": Object("cylinder", (13, 6), 6, turn=(0, 90, 0)),
    "pen": Object("capsule", (4, 20), 4, turn=(90, 0, 0), friction=0.5),
    "egg": Object("ellipsoid", (14, 11, 17), 14),
    "pebble": Object("ellipsoid", (8, 18, 12), 8, friction=0.5),
}


def place(cell: int) -> tuple[float, float]:
    """Return y and z of a cell in metres: rows go down, the columns of the two pads face."""
    pad, row, col = LAYOUT.position(cell)
    across = (col - (LAYOUT.cols - 1) / 2) * PITCH
    down = (row - (LAYOUT.rows - 1) / 2) * PITCH
    return (across if pad == 0 else -across), -down


def scene(thing: Object) -> mujoco.MjModel:
    """Return the gripper around an object; geom i is cell i, the last one the object."""
    pads = []
    reach = thing.half * MILLIMETRE + 0.004  # from the middle to a dome's top while it is open
    for pad, side in enumerate((-1, 1)):
        cells = []
        for cell in range(pad * LAYOUT.n_cells // 2, (pad + 1) * LAYOUT.n_cells // 2):
            y, z = place(cell)
            cells.append(
                f'<geom class="cell" pos="{side * (reach + DOME)} {y} {z}" size="{DOME}"/>'
            )
        pads.append(
            f'<body><inertial pos="0 0 0" mass=".3" diaginertia=".001 .001 .001"/>'
            f'<joint name="pad{pad}" type="slide" axis="{-side} 0 0" range="0 .02" limited="true"'
            f' damping="60"/>{"".join(cells)}</body>'
        )
    size = " ".join(str(length * MILLIMETRE) for length in thing.size)
    text = f"""<mujoco>
      <compiler angle="degree"/>
      <option timestep="{TIMESTEP}" cone="elliptic" impratio="10" integrator="implicitfast"/>
      <default><default class="cell">
        <geom type="sphere" contype="1" conaffinity="2" condim="4" priority="1"
         solimp=".5 .5 .001 .5 2" friction="{thing.friction} .002 .0001"/>
      </default></default>
      <worldbody>{"".join(pads)}
        <body name="fixture" mocap="true"/>
        <body name="object"><freejoint/>
          <geom type="{thing.shape}" size="{size}" mass=".2" contype="2" conaffinity="1"/>
        </body>
      </worldbody>
      <equality>
        <joint joint1="pad0" joint2="pad1"/>
        <weld body1="fixture" body2="object" solref=".01 1"/>
      </equality>
      <actuator><motor joint="pad0" name="grip"/></actuator>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    # At rest a contact carries stiffness * depth / ((1 - impedance) * inverse mass of the two
    # bodies) (MuJoCo, "Solver parameters").
    series = 1 / (1 / CELL + 1 / thing.stiffness)
    impedance = 0.5
    body = model.body("object").id
    inverse = model.body_invweight0[[1, body], 0].sum()
    stiffness = series * inverse * (1 - impedance)
    model.geom_solref[: LAYOUT.n_cells] = (-stiffness, -2 * np.sqrt(stiffness))
    return model


def turned(degrees: Floats) -> Floats:
    """Return the quaternion of a rotation about x, y and z of the world."""
    whole = np.zeros(4)
    mujoco.mju_euler2Quat(whole, np.radians(degrees), "XYZ")
    return whole


def pose(thing: Object, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return where the fixture holds the object, and its quaternion."""
    at = rng.uniform(-1, 1, 3) * (0.0005, 0.007, 0.007)
    swing = turned(rng.uniform(-1, 1, 3) * (20, 4, 4))
    whole = np.zeros(4)
    mujoco.mju_mulQuat(whole, swing, turned(np.array(thing.turn, float)))
    return at, whole


def loads(data: mujoco.MjData) -> Floats:
    """Return the normal force on each cell, ``[D]`` in newtons."""
    contact = data.contact
    found = np.zeros(LAYOUT.n_cells)
    pressed = contact.efc_address >= 0
    cells = contact.geom[pressed].min(axis=1)  # the object's geom comes after all cells
    np.add.at(found, cells, data.efc_force[contact.efc_address[pressed]])
    return found


def grasp(name: str, seed: int) -> Floats:
    """Return the forces of one recording, float32 ``[60, D]`` in newtons.

    Args:
        name: which of ``OBJECTS``.
        seed: draws poses, grip forces and slips.

    Raises:
        RuntimeError: MuJoCo warned, as of an unstable step.
    """
    thing = OBJECTS[name]
    rng = np.random.default_rng([seed, list(OBJECTS).index(name)])
    model = scene(thing)
    data = mujoco.MjData(model)
    frames = []
    for again in range(2):
        at, quaternion = pose(thing, rng)
        data.mocap_pos[0] = at
        data.mocap_quat[0] = quaternion
        if not again:
            data.qpos[2:] = np.concatenate([at, quaternion])
        force = rng.uniform(15, 40)
        slips = rng.random() < 0.5
        slip_at = rng.integers(120, 230)
        pull = rng.uniform(2, 6) * MILLIMETRE
        direction = rng.uniform(0, 2 * np.pi)
        way = pull * np.array([0, np.cos(direction), np.sin(direction)])
        tremor = 0.0
        for tick in range(HELD):
            tremor = 0.9 * tremor + 0.006 * rng.standard_normal()
            share = np.clip((tick - CLOSING[0]) / (CLOSING[1] - CLOSING[0]), 0, 1)
            grip = APPROACH + (force - APPROACH) * share**2
            data.ctrl[0] = 2 * grip * (1 + tremor) if tick >= CLOSING[0] else -2 * APPROACH
            pulled = slips and slip_at <= tick < slip_at + 30
            if pulled and tick == slip_at:
                data.mocap_pos[0] = data.body("object").xpos
                data.mocap_quat[0] = data.body("object").xquat
            if pulled:
                data.mocap_pos[0] += way / 30
            data.eq_active[1] = tick < CLOSING[1] or pulled
            mujoco.mj_step(model, data, round(0.01 / TIMESTEP))
            if tick % 10 == 9:
                frames.append(loads(data))
    if any(warning.number for warning in data.warning):
        raise RuntimeError(f"{name}, seed {seed}: MuJoCo warned, see MUJOCO_LOG.TXT")
    return np.array(frames, np.float32)


def read(forces: Floats, circuit: Circuit, seed: int) -> Floats:
    """Return the readings of forces ``[T, D]`` in newtons, float32 of the same shape.

    The gains belong to the sensor and are the same for every ``seed``, which draws the noise.
    """
    gain = np.random.default_rng(0).lognormal(0, 0.1, LAYOUT.n_cells)
    noise = np.random.default_rng(seed).normal(0, 0.004, forces.shape)
    readings = circuit.read(forces * gain) + noise
    step = LAYOUT.full_scale / 4095
    return np.clip(np.rint(readings / step) * step, 0, LAYOUT.full_scale).astype(np.float32)


def record(grasps: int, *, seed: int = 0, objects: Sequence[str] = tuple(OBJECTS)) -> list[Floats]:
    """Return the forces of ``grasps`` recordings of each object, object by object, from all CPUs.

    Recording ``number`` of an object has the seed ``seed + number``.
    """
    tasks = [delayed(grasp)(name, seed + number) for name in objects for number in range(grasps)]
    return list(Parallel(n_jobs=-1)(tasks))


def as_recordings(frames: Sequence[Floats], objects: Sequence[str] = tuple(OBJECTS)) -> Recordings:
    """Return readings, as many of each object, with their classes and names."""
    grasps = len(frames) // len(objects)
    labels = np.repeat(np.arange(len(objects)), grasps)
    names = tuple(f"{name}/{number:04d}" for name in objects for number in range(grasps))
    return Recordings(tuple(frames), LAYOUT, labels, tuple(objects), names)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grasps", type=int, default=24, help="recordings of each object")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="grasps.npz")
    args = parser.parse_args()
    circuit = Circuit(LAYOUT)
    frames = [
        read(forces, circuit, number)
        for number, forces in enumerate(record(args.grasps, seed=args.seed))
    ]
    recordings = as_recordings(frames)
    save_npz(args.out, recordings)
    print(f"{len(recordings)} recordings of {len(OBJECTS)} objects: {args.out}")


if __name__ == "__main__":
    main()
