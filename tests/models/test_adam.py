"""Adam in one fused pass, without torch's class, which imports a compiler."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor, nn

from adaptfault.models.adam import Adam


def stepped(optimizer, parameters: list[Tensor], steps: int = 5) -> list[Tensor]:
    """Return the parameters after steps down the gradient of a sum of squares of all but the
    last."""
    for step in range(steps):
        optimizer.zero_grad()
        sum(((p - step) ** 2).sum().double() for p in parameters[:-1]).backward()
        optimizer.step()
    return [p.detach().clone() for p in parameters]


def parameters() -> list[nn.Parameter]:
    """Of two types; the last gets no gradient."""
    rng = torch.Generator().manual_seed(0)
    shapes = [((3, 4), torch.float32), ((5,), torch.float64), ((2,), torch.float32)]
    return [nn.Parameter(torch.randn(size, generator=rng, dtype=of)) for size, of in shapes]


def test_steps_are_those_of_the_paper_and_what_has_no_gradient_stays():
    given = parameters()
    expected = [p.detach().double() for p in given]
    moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in expected]
    for step in range(5):
        for i in (0, 1):
            gradient = 2 * (expected[i] - step)
            first = 0.9 * moments[i][0] + 0.1 * gradient
            second = 0.999 * moments[i][1] + 0.001 * gradient**2
            moments[i] = (first, second)
            first = first / (1 - 0.9 ** (step + 1))
            second = second / (1 - 0.999 ** (step + 1))
            expected[i] = expected[i] - 0.01 * first / (second.sqrt() + 1e-8)
    optimizer = Adam(given, 0.01)
    found = stepped(optimizer, given)
    for one, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(one.double(), wanted, rtol=1e-5, atol=1e-6)
    assert torch.equal(found[2], parameters()[2])
    assert set(optimizer.state) == set(given[:2])
    assert all(state["step"].item() == 5 for state in optimizer.state.values())


@pytest.mark.slow  # as torch's own class takes seconds to begin
def test_steps_are_those_of_torchs_class_to_the_bit():
    ours = parameters()
    theirs = parameters()
    found = stepped(Adam(ours, 0.01), ours)
    wanted = stepped(torch.optim.Adam(theirs, lr=0.01, fused=True), theirs)
    assert all(map(torch.equal, found, wanted))


@pytest.mark.slow
def test_a_training_imports_no_compiler():
    code = (
        "import sys, numpy as np; from adaptfault import TactileTransformer, Windows, train\n"
        "from diagnostics import SensorLayout\n"
        "x = np.zeros((32, 10, 4), np.float32); y = np.arange(32) % 2\n"
        "windows = Windows(x, y, np.arange(32)); layout = SensorLayout(1, 2, 2)\n"
        "train(TactileTransformer(layout, 2), windows, windows, epochs=1, progress=False)\n"
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
