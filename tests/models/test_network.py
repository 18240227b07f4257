"""The network is the paper's, for any layout."""

import numpy as np
import pytest
import torch

from adaptfault.models.network import Dropout, TactileTransformer, logits_of
from diagnostics import SensorLayout

SMALL = SensorLayout(1, 4, 4)


pytestmark = pytest.mark.usefixtures("one_thread")


def windows(layout: SensorLayout, n: int = 3, length: int = 10) -> torch.Tensor:
    return torch.rand(n, length, layout.n_cells, generator=torch.Generator().manual_seed(1))


def test_the_parameters_have_the_sizes_of_the_paper():
    shapes = {
        name: tuple(p.shape)
        for name, p in TactileTransformer(SensorLayout.paper(), 7).named_parameters()
    }
    d = 32 * 11 * 10
    assert shapes["conv1.weight"] == (16, 2, 3, 3)
    assert shapes["conv2.weight"] == (32, 16, 3, 3)
    for i in range(2):
        assert shapes[f"blocks.{i}.qkv.weight"] == (3 * 4 * 64, d)
        assert shapes[f"blocks.{i}.out.weight"] == (d, 4 * 64)
        assert shapes[f"blocks.{i}.up.weight"] == (128, d)
        assert shapes[f"blocks.{i}.down.weight"] == (d, 128)
        assert shapes[f"blocks.{i}.norm1.weight"] == shapes[f"blocks.{i}.norm2.weight"] == (d,)
    assert "blocks.2.qkv.weight" not in shapes
    assert shapes["dense.weight"] == (128, d)
    assert shapes["head.weight"] == (7, 128)


@pytest.mark.parametrize("shape", [(2, 11, 10), (1, 4, 4), (3, 13, 6), (1, 1, 1), (1, 24, 16)])
def test_any_layout_gives_logits(shape: tuple[int, int, int]):
    layout = SensorLayout(*shape)
    model = TactileTransformer(layout, 5)
    assert model(windows(layout)).shape == (3, 5)
    assert model.features(windows(layout)).shape == (3, 128)


def test_without_padding_the_grid_shrinks_by_four():
    layout = SensorLayout(2, 6, 5)
    assert TactileTransformer(layout, 2, padding="valid").dense.in_features == 32 * 2 * 1
    with pytest.raises(ValueError, match="needs pads of 5 x 5, these have 4 x 4"):
        TactileTransformer(SMALL, 2, padding="valid")


def test_the_pads_are_the_channels_of_the_convolutions():
    layout = SensorLayout(2, 4, 5)
    model = TactileTransformer(layout, 2, length=1).eval()
    seen = []
    model.conv1.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    x = torch.arange(40.0).reshape(1, 1, 40)
    model(x)
    assert seen[0].shape == (1, 2, 4, 5)
    assert seen[0][0, 1, 2, 3] == layout.cell(1, 2, 3)


def test_each_frame_is_seen_alone_and_their_order_does_not_matter():
    model = TactileTransformer(SMALL, 3).eval()
    x = windows(SMALL)
    torch.testing.assert_close(model(x), model(x.flip(1)))


def test_the_attention_is_the_paper_s_formula():
    block = TactileTransformer(SMALL, 3).eval().blocks[0]
    x = torch.rand(2, 10, 32 * 16)
    q, k, v = (
        x @ w.T + b
        for w, b in zip(block.qkv.weight.split(256), block.qkv.bias.split(256), strict=True)
    )
    heads = []
    for h in range(4):
        part = slice(64 * h, 64 * h + 64)
        weights = (q[..., part] @ k[..., part].transpose(1, 2) / 64**0.5).softmax(-1)
        heads.append(weights @ v[..., part])
    x1 = block.norm1(x + block.out(torch.cat(heads, -1)))
    expected = block.norm2(x1 + block.down(block.up(x1).relu()))
    torch.testing.assert_close(block(x), expected)


def test_the_head_turns_features_into_logits():
    model = TactileTransformer(SMALL, 3).eval()
    features = model.features(windows(SMALL))
    assert (features >= 0).all()
    torch.testing.assert_close(model.head(features), model(windows(SMALL)))


def test_positions_without_a_cell_cannot_influence_anything_even_as_nan():
    present = np.ones((1, 4, 4), bool)
    present[0, 0, 0] = present[0, 3, 1] = False
    layout = SensorLayout(1, 4, 4, present=present)
    model = TactileTransformer(layout, 3)
    x = windows(layout)
    x[..., ~present.ravel()] = 0
    clean = model.predict_proba(x)
    for anything in (float("nan"), float("inf"), 1e9):
        x[..., ~present.ravel()] = anything
        np.testing.assert_array_equal(model.predict_proba(x), clean)
    model(x).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def test_the_seed_decides_the_weights_and_the_global_generator_is_left_alone():
    before = torch.random.get_rng_state()
    a, b, c = (TactileTransformer(SMALL, 3, seed=s).state_dict() for s in (4, 4, 5))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not torch.equal(a["head.weight"], c["head.weight"])


def test_glorot_weights_start_as_in_keras():
    model = TactileTransformer(SMALL, 3, init="glorot")
    d = 32 * 16
    for weight in model.blocks[1].qkv.weight.split(256):
        limit = (6 / (d + 256)) ** 0.5
        assert 0.99 * limit < weight.abs().max() <= limit
    assert (model.blocks[1].qkv.bias == 0).all()
    assert (model.conv1.bias == 0).all()


def test_prediction_takes_arrays_and_tensors_in_batches_and_keeps_the_mode():
    model = TactileTransformer(SMALL, 3)
    model.blocks[0].eval()
    x = windows(SMALL, 7)
    frozen = x.numpy().copy()
    frozen.setflags(write=False)
    classes = model.predict(frozen)
    assert classes.dtype == np.int64
    assert model.training
    assert not model.blocks[0].training
    np.testing.assert_array_equal(classes, model.predict(x))
    np.testing.assert_array_equal(classes, model.predict(x.numpy().astype(np.float64)))
    np.testing.assert_allclose(model.predict_proba(x).sum(1), 1, rtol=1e-5)
    torch.testing.assert_close(logits_of(model, x, batch_size=2), logits_of(model, x))
    assert model.predict(x[:0]).shape == (0,)


def test_windows_of_another_shape_are_refused_in_one_line():
    model = TactileTransformer(SMALL, 3)
    for shape in [(2, 10, 15), (2, 9, 16), (10, 16)]:
        with pytest.raises(ValueError, match=r"^expected windows \[N, 10, 16\], got \[") as error:
            model(torch.zeros(shape))
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="unknown padding"):
        TactileTransformer(SMALL, 3, padding="full")
    with pytest.raises(ValueError, match="n_classes >= 1"):
        TactileTransformer(SMALL, 0)


def test_the_config_builds_the_same_network_again():
    model = TactileTransformer(
        SensorLayout(2, 6, 5, unit="counts"), 3, length=4, padding="valid", dropout=0.2, seed=9
    )
    again = TactileTransformer.from_config(model.config)
    assert again.config == model.config
    assert again.layout == model.layout
    assert all(
        torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True)
    )


def test_dropout_drops_its_share_and_keeps_the_mean():
    dropout = Dropout(0.1)
    x = torch.ones(1001, 999, requires_grad=True)
    out = dropout(x)
    assert (out == 0).float().mean().item() == pytest.approx(0.1, abs=0.002)
    assert out.mean().item() == pytest.approx(1, abs=0.002)
    out.sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad, out.detach())
    assert dropout.eval()(x) is x
    assert Dropout(0.0)(x) is x
    with pytest.raises(ValueError, match="dropout must lie"):
        Dropout(1.0)


def test_rests_and_the_gain_of_the_readings_change_nothing_of_what_it_learns():
    layout = SensorLayout(2, 4, 4)
    x = np.random.default_rng(0).random((20, 5, 32)).astype(np.float32)
    rests = np.linspace(0.1, 0.5, 32, dtype=np.float32)
    first, second = (TactileTransformer(layout, 3, length=5).eval() for _ in range(2))
    first.standardise(x)
    second.standardise(0.05 * x + rests)
    a = first.features(torch.from_numpy(x))
    b = second.features(torch.from_numpy(0.05 * x + rests))
    torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    first.standardise(2 * x)  # once is enough
    assert torch.equal(first.features(torch.from_numpy(x)), a)


def test_readings_as_they_are_stay_so():
    layout = SensorLayout(1, 4, 4)
    x = np.random.default_rng(0).random((20, 5, 16)).astype(np.float32)
    plain = TactileTransformer(layout, 3, length=5, inputs="readings").eval()
    before = plain.features(torch.from_numpy(x))
    plain.standardise(x)
    assert torch.equal(plain.features(torch.from_numpy(x)), before)
    with pytest.raises(ValueError, match="unknown inputs"):
        TactileTransformer(layout, 3, inputs="loads")
