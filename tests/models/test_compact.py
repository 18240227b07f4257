import numpy as np
import pytest
import torch

from adaptfault.models import compact
from adaptfault.models.compact import CompactNetwork
from adaptfault.models.network import TactileTransformer
from diagnostics import SensorLayout

MASKED = SensorLayout(2, 6, 5, present=np.arange(60) % 7 != 3)


def windows(n: int, network: TactileTransformer) -> torch.Tensor:
    """Half of the cells touched; some windows touched by nothing, some by far more than a sensor
    reads."""
    rng = np.random.default_rng(0)
    shape = (n, network.length, network.layout.n_cells)
    x = np.where(rng.random((n, 1, shape[2])) < 0.5, rng.random(shape), 0) * rng.choice(
        [0, 0.01, 1, 30], (n, 1, 1)
    )
    return torch.from_numpy(x.astype(np.float32))


def restless(network: TactileTransformer) -> TactileTransformer:
    """Give norms and biases other values than the initial ones, as training does."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.dim() == 1:
                parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return network.eval()


@pytest.mark.parametrize(
    ("layout", "settings"),
    [
        (SensorLayout(2, 9, 8), {"padding": "valid", "init": "glorot"}),
        (MASKED, {"length": 3}),
        (SensorLayout(1, 1, 2), {"length": 1}),
    ],
)
def test_it_says_what_the_network_says(layout, settings):
    network = restless(TactileTransformer(layout, 5, **settings))
    x = windows(40, network)
    with torch.no_grad():
        features, given = network.features(x), CompactNetwork(network).features(x)
        torch.testing.assert_close(given, features, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(CompactNetwork(network)(x), network(x), rtol=1e-5, atol=1e-5)
    assert features.std(0).max() > 1e-3


def test_positions_without_a_cell_say_nothing():
    network = restless(TactileTransformer(MASKED, 3, length=3))
    x = windows(5, network)
    small = CompactNetwork(network)
    usual = small(x)
    x[..., ~MASKED.present.ravel()] = torch.nan
    assert torch.equal(small(x), usual)


def test_the_papers_network_takes_a_third_of_the_numbers_and_says_the_same():
    network = restless(TactileTransformer(SensorLayout.paper(), 7))
    small = CompactNetwork(network)
    x = windows(20, network)
    numbers = [sum(p.numel() for p in module.parameters()) for module in (network, small)]
    assert numbers[1] < 0.35 * numbers[0]
    torch.testing.assert_close(small(x), network(x), rtol=1e-5, atol=1e-5)


def test_the_network_is_left_as_it_was_and_its_dropout_does_not_count():
    network = TactileTransformer(MASKED, 3, dropout=0.5).train()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    small = CompactNetwork(network)
    x = windows(4, network)
    assert network.training
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())
    torch.testing.assert_close(small(x), network.eval()(x), rtol=1e-5, atol=1e-5)


def test_very_large_arrays_are_left_alone(monkeypatch):
    assert CompactNetwork.suits(TactileTransformer(SensorLayout(2, 16, 16), 3))
    network = TactileTransformer(MASKED, 3)
    assert CompactNetwork.suits(network)
    monkeypatch.setattr(compact, "_MOST", 700_000)
    assert not CompactNetwork.suits(network)


def test_cut_to_windows_it_says_nearly_what_the_network_says_of_such_windows():
    rng = np.random.default_rng(0)
    layout = SensorLayout(2, 6, 5)
    network = restless(TactileTransformer(layout, 3, length=5))
    place = rng.random((2, 300, 1, 1))  # contacts in few shapes, at a high rest
    shape = np.exp(-((np.linspace(0, 1, 60) - place[0]) ** 2) * 8) * place[1]
    x = torch.from_numpy((5 + shape + np.zeros((300, 5, 60))).astype(np.float32))
    small = compact.CompactNetwork(network, x[:150])
    with torch.no_grad():
        expected = network.features(x[150:])
        found = small.features(x[150:])
    spread = (expected - expected.mean(0)).square().sum()
    assert (found - expected).square().sum() < 0.05**2 * spread
    numbers = [sum(p.numel() for p in of.parameters()) for of in (CompactNetwork(network), small)]
    assert numbers[1] < 0.5 * numbers[0]


def test_few_windows_or_a_large_basis_are_not_worth_the_decomposition(monkeypatch):
    network = TactileTransformer(MASKED, 3, length=3)
    x = windows(40, network)
    assert compact.compacted(network, x) is None
    monkeypatch.setattr(compact, "_WORTH", 40)
    assert compact.compacted(network, x) is not None
    monkeypatch.setattr(compact, "_MOST", 700_000)
    assert compact.compacted(network, x) is None
