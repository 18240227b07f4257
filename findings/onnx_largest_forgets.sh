#!/bin/sh
# Guess: the largest reading of a pad, exported from torch to ONNX, is NaN where one cell is
#   missing, as in torch; or the missing cell is passed over, as with nanmax.
# Reality: neither. ONNX Runtime returns a number that can be less than the largest of the others:
#   a missing cell can hide one that is there. Of a pad whose cells read 0 to 7, cell 1 missing, the
#   largest is 6, though cell 7 reads 7. It depends on the place of the missing cell; of the eight
#   places only the first gives NaN. A guard that waits for NaN behind such a model does not see
#   it, and a limit on the load is passed unseen.
# Packages: torch==2.13.0 (Python 3.11: a build for CPUs), onnx==1.23.2, onnxscript==0.7.2,
#   onnxruntime==1.31.1, numpy==2.4.6; on x86-64
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3.11 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 onnx==1.23.2 onnxscript==0.7.2 \
  onnxruntime==1.31.1 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" -W ignore - <<'PY'
import sys

import numpy as np
import onnxruntime
import torch

CELLS = 8


class Largest(torch.nn.Module):
    """The largest reading of each frame."""

    def forward(self, x):
        return x.amax(dim=1)


pads = torch.arange(float(CELLS)).repeat(CELLS, 1)
pads.fill_diagonal_(float("nan"))  # in frame k, cell k is missing
torch.onnx.export(Largest(), (pads,), "largest.onnx", dynamo=True, verbose=False)
session = onnxruntime.InferenceSession("largest.onnx", providers=["CPUExecutionProvider"])
(found,) = session.run(None, {session.get_inputs()[0].name: pads.numpy()})
present = np.nanmax(pads.numpy(), axis=1)
print("torch", torch.__version__, "onnxruntime", onnxruntime.__version__)
print("largest of the cells that are there:", present.tolist())
print("torch:", Largest()(pads).tolist())
print("onnxruntime:", found.tolist())
too_small = int((found < present).sum())
print(f"too small in {too_small} of {CELLS} frames, NaN in {int(np.isnan(found).sum())}")
if not bool(Largest()(pads).isnan().all()) or too_small == 0 or np.isnan(found).sum() != 1:
    sys.exit("changed: expected NaN throughout, and largest readings that are too small")
PY
