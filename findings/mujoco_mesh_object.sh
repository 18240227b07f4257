#!/bin/sh
# Guess: a tactile sensor of MuJoCo reads an object by where it is, not by how its shape is stored.
# Reality: an object that is a mesh collides, holds and carries weight as ever, and every taxel
#   reads exactly 0; a sphere as a mesh is invisible to the sensor, the same sphere as a sphere is
#   read. Nothing is told at compilation or in the simulation. A policy that is trained on a set of
#   scanned objects learns that touch is silent, and grasps of such a set look like a dead skin.
# Package: mujoco==4.0.0
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet mujoco==4.0.0
"$work/venv/bin/python" - <<'PY'
import sys

import mujoco
import numpy as np

print("mujoco", mujoco.__version__)
MODEL = """
<mujoco>
  <asset>
    <mesh name="skin" builtin="plate" params="8 8" scale=".05 .05 .01"/>
    <mesh name="ball" builtin="sphere" params="3" scale=".02 .02 .02"/>
  </asset>
  <worldbody>
    <geom name="pad" type="box" size=".05 .05 .005" pos="0 0 -.005"/>
    <body pos="0 0 .0195"><freejoint/><geom {shape} mass=".1"/></body>
  </worldbody>
  <sensor><tactile geom="pad" mesh="skin"/></sensor>
</mujoco>
"""
SHAPES = {
    "sphere": 'type="sphere" size=".02"',
    "ellipsoid": 'type="ellipsoid" size=".02 .02 .02"',
    "mesh": 'type="mesh" mesh="ball"',
}
read = {}
for name, shape in SHAPES.items():
    model = mujoco.MjModel.from_xml_string(MODEL.format(shape=shape))
    data = mujoco.MjData(model)
    for _ in range(1000):  # two seconds: the object lies still on the pad
        mujoco.mj_step(model, data)
    taxels = int(np.count_nonzero(data.sensordata))
    read[name] = (taxels, data.ncon)
    print(f"{name}: {data.ncon} contacts, at {data.qpos[2]:.4f} m, {taxels} numbers that are not 0")
held = all(contacts > 0 for _, contacts in read.values())
seen = read["sphere"][0] > 0 and read["ellipsoid"][0] > 0
if not held or not seen or read["mesh"][0] != 0:
    sys.exit("changed: expected contacts everywhere, and no reading of the mesh alone")
PY
