#!/bin/sh
# Guess: training with fake quantisation shows a network what its quantised inputs will be;
#   whatever becomes of a missing reading (NaN), it is the same in training, in torch on 8 bits and
#   in ONNX.
# Reality: fake quantisation makes it the least value, no touch; torch's 8-bit tensor makes it the
#   greatest, a cell at full scale; ONNX Runtime on the exported model the least again. A network
#   that was trained to bear missing cells meets a full load in their place once torch quantises
#   it. No error, no warning about the reading, and none of the three keeps the NaN.
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

import onnxruntime
import torch

FULL_SCALE = 4.0
STEP = FULL_SCALE / 255
readings = torch.tensor([[0.5, float("nan"), 2.0]])


class Input(torch.nn.Module):
    """The first layer of a network that is trained for 8 bits."""

    def forward(self, x):
        return torch.fake_quantize_per_tensor_affine(x, STEP, 0, 0, 255)


trained = Input()(readings)
stored = torch.quantize_per_tensor(readings, STEP, 0, torch.quint8).dequantize()
torch.onnx.export(Input(), (readings,), "input.onnx", dynamo=True, verbose=False)
session = onnxruntime.InferenceSession("input.onnx", providers=["CPUExecutionProvider"])
(exported,) = session.run(None, {session.get_inputs()[0].name: readings.numpy()})
print("torch", torch.__version__, "onnxruntime", onnxruntime.__version__)
missing = [float(one[0, 1]) for one in (trained, stored, exported)]
print("a missing reading is in training, in torch on 8 bits, in ONNX Runtime:", missing)
others = [abs(float(one[0, 0]) - 0.5) for one in (trained, stored, exported)]
if missing != [0.0, FULL_SCALE, 0.0] or max(others) > STEP:
    sys.exit("changed: expected [0.0, 4.0, 0.0]")
PY
