import json

import numpy as np
import pytest
import torch

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.adapter_files import (
    LIMIT,
    load_adapter,
    load_windows,
    save_adapter,
    save_windows,
)
from adaptfault.data.windows import Windows
from adaptfault.models.network import TactileTransformer
from diagnostics import FaultSet, SensorLayout

LAYOUT = SensorLayout(2, 4, 4)
D = LAYOUT.n_cells
F = FaultSet((0, 5, 6, 7, 21), D)


def counts(n: int, seed: int, step: float = 1 / 4095) -> Windows:
    """Windows of a 12-bit converter, mostly zero; step 0 leaves them as they are."""
    rng = np.random.default_rng(seed)
    x = np.maximum(rng.normal(0, 0.2, (n, 10, D)), 0).clip(0, 1)
    x = np.rint(x / step) * step if step else x
    return Windows(x.astype(np.float32), rng.integers(0, 3, n), np.arange(n))


def adapter(step: float = 1 / 4095, layout: SensorLayout = LAYOUT) -> Adapter:
    return Adapter(
        TactileTransformer(layout, 3, seed=1).eval(), counts(120, 0, step), counts(40, 1, step)
    )


def size(folder) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())


def test_an_adapter_comes_back_and_adapts_as_before(tmp_path):
    first = adapter()
    save_adapter(tmp_path, first)
    again = load_adapter(tmp_path)
    for name in ("train", "validation"):
        for key in ("x", "y", "recording"):
            np.testing.assert_array_equal(
                getattr(getattr(again, name), key), getattr(getattr(first, name), key)
            )
    x = first.validation.x
    for method in ("fill", "head"):
        one = first.adapt(F, method=method)
        other = again.adapt(F, method=method)
        np.testing.assert_allclose(other.predict_proba(x), one.predict_proba(x), atol=1e-3)
    with torch.no_grad():
        assert torch.equal(
            again.adapt(FaultSet((), D), method="fill").model(torch.from_numpy(x)),
            first.model(torch.from_numpy(x)),
        )


def test_readings_without_steps_are_kept_to_12_bits(tmp_path):
    first = adapter(step=0)
    save_adapter(tmp_path, first)
    np.testing.assert_allclose(load_adapter(tmp_path).train.x, first.train.x, atol=0.51 / 4095)


def test_readings_below_zero_and_above_full_scale_survive(tmp_path):
    wide = counts(30, 0)
    wide.x[0, 0, :3] = (-0.5, 1.75, 7.0)
    save_adapter(tmp_path, Adapter(TactileTransformer(LAYOUT, 3), wide, counts(10, 1)))
    np.testing.assert_allclose(load_adapter(tmp_path).train.x, wide.x, atol=1e-3)


@pytest.mark.slow
def test_the_papers_layout_fits_into_20_mb_with_many_windows(tmp_path):
    layout = SensorLayout.paper()
    rng = np.random.default_rng(0)
    x = np.maximum(rng.normal(-0.1, 0.2, (2000, 10, 220)), 0).astype(np.float32)
    data = Windows(x, rng.integers(0, 7, 2000), np.arange(2000))
    first = Adapter(TactileTransformer(layout, 7), data, data.select(slice(0, 200)))
    save_adapter(tmp_path, first)
    assert size(tmp_path) <= LIMIT == 20_000_000
    again = load_adapter(tmp_path)
    told = json.loads((tmp_path / "manifest.json").read_text())
    assert told["weights_as"] == "int8"  # 9.5 million weights
    assert told["train"]["of"] == 2000
    close = (
        first.model.predict_proba(data.x[:200]) - again.model.predict_proba(data.x[:200])
    ).max()
    assert abs(close) < 0.02


def test_the_network_of_a_large_array_raises_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr("adaptfault.adaptation.adapter_files.LIMIT", 100_000)
    first = adapter()
    save_adapter(tmp_path, first)
    weights = sum(value.numel() for value in first.model.state_dict().values())
    assert weights > 100_000
    assert size(tmp_path) < 3 * weights
    assert load_adapter(tmp_path).model.n_classes == first.model.n_classes


def test_a_tight_limit_thins_windows_evenly_and_too_tight_a_one_is_refused(tmp_path):
    first = adapter()
    weights = sum(p.numel() for p in first.model.parameters())
    save_adapter(tmp_path, first, limit=2 * weights)
    assert size(tmp_path) <= 2 * weights
    kept = load_adapter(tmp_path).train.recording
    assert (kept[0], kept[-1]) == (0, 119)
    with pytest.raises(ValueError, match=r"does not fit into 100,000 bytes.*raise limit"):
        save_adapter(tmp_path, first, limit=100_000)
    load_adapter(tmp_path)  # what was there before is still there


def test_soft_targets_survive(tmp_path):
    data = counts(60, 0)
    first = Adapter(
        TactileTransformer(LAYOUT, 3),
        Windows(data.x, np.full(60, -1), data.recording),
        counts(20, 1),
    )
    save_adapter(tmp_path, first)
    np.testing.assert_allclose(load_adapter(tmp_path).targets, first.targets, atol=1e-3)


def test_a_damaged_adapter_is_refused_in_one_line(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_adapter(tmp_path)
    save_adapter(tmp_path, adapter())
    manifest = tmp_path / "manifest.json"
    whole = manifest.read_text()
    for old, new in (
        ('"train"', '"trained"'),
        ('"low"', '"lower"'),
        ('"n_classes": 3', '"n_classes": 4'),
    ):
        manifest.write_text(whole.replace(old, new))
        with pytest.raises(ValueError, match="is damaged") as error:
            load_adapter(tmp_path)
        assert "\n" not in str(error.value)
    manifest.write_text(whole.replace("120,", "100000000,"))
    with pytest.raises(ValueError, match="is damaged"):
        load_adapter(tmp_path)


def regression(scale: float = 4000.0) -> Adapter:
    """Two values of each window, of very different size."""
    units = np.array([scale, 0.001], np.float32)
    parts = [counts(120, 0), counts(40, 1)]
    for i, part in enumerate(parts):
        y = np.stack([part.x.mean((1, 2)), part.x[:, -1].max(1)], axis=1) * units
        parts[i] = Windows(part.x, y, part.recording)
    return Adapter(TactileTransformer(LAYOUT, 2, seed=1).eval(), *parts)


def test_the_adapter_of_a_regression_comes_back_with_its_task_and_its_values(tmp_path):
    first = regression()
    save_adapter(tmp_path, first)
    again = load_adapter(tmp_path)
    assert again.task == "regression"
    for name in ("train", "validation"):
        one, other = getattr(first, name), getattr(again, name)
        assert other.y.dtype == np.float32
        np.testing.assert_array_equal(one.y, other.y)
    np.testing.assert_array_equal(first.targets, again.targets)
    x = first.validation.x
    one, other = (of.adapt(F, method="head").predict(x) for of in (first, again))
    np.testing.assert_allclose(one / [4000, 0.001], other / [4000, 0.001], atol=1e-3)


def test_the_windows_of_a_regression_come_back_without_loss(tmp_path):
    windows = regression().train
    save_windows(tmp_path, windows)
    again = load_windows(tmp_path)
    for key in ("x", "y", "recording"):
        np.testing.assert_array_equal(getattr(again, key), getattr(windows, key))


def test_weights_too_large_or_too_small_for_16_bits_stay_as_they_are(tmp_path):
    first = regression()
    with torch.no_grad():
        first.model.head.bias.copy_(torch.tensor([2e6, 2e-7]))
    weights = sum(p.numel() for p in first.model.parameters())
    save_adapter(tmp_path, first, limit=2 * weights)
    assert json.loads((tmp_path / "manifest.json").read_text())["weights_as"] == "int8"
    bias = load_adapter(tmp_path).model.head.bias.detach().numpy()
    np.testing.assert_allclose(bias, [2e6, 2e-7], rtol=1e-6)


def test_an_adapter_whose_task_does_not_fit_its_targets_is_damaged(tmp_path):
    save_adapter(tmp_path, regression())
    manifest = tmp_path / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"regression"', '"classification"'))
    with pytest.raises(ValueError, match="is damaged"):
        load_adapter(tmp_path)
