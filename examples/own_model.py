"""Repair a model of your own, here an LSTM: python examples/own_model.py"""

import torch
from torch import nn

from adaptfault import Adapter, evaluate, make_windows, simulate, split, train
from diagnostics import FaultSet, SensorLayout


class Lstm(nn.Module):
    def __init__(self, n_cells: int, n_classes: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(n_cells, 64, batch_first=True)
        self.last = nn.Linear(64, n_classes)

    def forward(self, x: torch.Tensor) -> torch.Tensor:  # [N, T, D] -> [N, n_classes]
        return self.last(self.lstm(x)[0][:, -1])


layout = SensorLayout(2, 6, 5)
grasps = simulate(30, layout, n_frames=60, seed=1, classes=("nothing", "softer", "harder"))
training, validation, test = split(make_windows(grasps.frames, grasps.labels, layout))
torch.manual_seed(0)
model = Lstm(layout.n_cells, 3)
train(model, training, validation, epochs=20, learning_rate=3e-3, progress=False)
print("fault-free:        ", evaluate(model, test))

faults = FaultSet(layout.cells_on(layout.lines[2]), layout.n_cells)  # a broken row reads full scale
test.x[..., faults.mask] = 1.0
print("broken row:        ", evaluate(model, test))
adapted = Adapter(model, training, validation, layout=layout).adapt(faults)
print("broken row, adapted:", evaluate(adapted, test))
