"""A model comes back from disk as it was, and a damaged one is told."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from adaptfault.adaptation.result import Adaptation, load_healthy
from adaptfault.data.atomic import atomic_write
from adaptfault.models.network import TactileTransformer
from adaptfault.models.store import SCHEMA, load_model, read_manifest, save_model
from diagnostics import SensorLayout


@pytest.fixture
def model() -> TactileTransformer:
    present = np.ones((1, 4, 4), bool)
    present[0, 0, 0] = False
    return TactileTransformer(
        SensorLayout(1, 4, 4, full_scale=4095, unit="counts", present=present), 3, length=5
    )


def test_a_model_comes_back_bit_for_bit(tmp_path: Path, model: TactileTransformer):
    save_model(
        tmp_path / "new" / "folder", model, class_names=("a", "b", "c"), extra={"accuracy": 0.5}
    )
    again = load_model(tmp_path / "new" / "folder")
    x = torch.rand(4, 5, 16)
    np.testing.assert_array_equal(again.predict_proba(x), model.predict_proba(x))
    assert again.layout == model.layout
    assert not again.training
    manifest = read_manifest(tmp_path / "new" / "folder", SCHEMA)
    assert manifest["class_names"] == ["a", "b", "c"]
    assert manifest["extra"] == {"accuracy": 0.5}
    assert manifest["schema"] == "adaptfault.model/1"


def test_weights_that_share_memory_or_are_not_contiguous_can_be_saved(
    tmp_path: Path, model: TactileTransformer
):
    model.blocks[0].up.weight.data = model.blocks[0].up.weight.data.T.contiguous().T
    model.blocks[0].up.bias = model.blocks[1].up.bias
    save_model(tmp_path, model)
    assert torch.equal(load_model(tmp_path).blocks[0].up.weight, model.blocks[0].up.weight)


def test_saving_again_replaces_the_model_and_leaves_no_old_weights(
    tmp_path: Path, model: TactileTransformer
):
    save_model(tmp_path, model)
    with torch.no_grad():
        model.head.bias += 1
    save_model(tmp_path, model)
    assert len(list(tmp_path.iterdir())) == 2
    assert torch.equal(load_model(tmp_path).head.bias, model.head.bias)


def test_a_crash_while_saving_leaves_the_old_model(
    tmp_path: Path, model: TactileTransformer, monkeypatch: pytest.MonkeyPatch
):
    save_model(tmp_path, model)
    old = model.head.bias.detach().clone()
    replace = os.replace

    def crash(source: str, target: Path) -> None:
        if target.name == "manifest.json":
            raise OSError("power lost")
        replace(source, target)

    with torch.no_grad():
        model.head.bias += 1
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", crash)
        with pytest.raises(OSError, match="power lost"):
            save_model(tmp_path, model)
    assert torch.equal(load_model(tmp_path).head.bias, old)
    save_model(tmp_path, model)
    assert len(list(tmp_path.iterdir())) == 2


def test_missing_files_are_named(tmp_path: Path, model: TactileTransformer):
    with pytest.raises(FileNotFoundError, match=r"expected a folder with a manifest.json"):
        load_model(tmp_path)
    save_model(tmp_path, model)
    next(tmp_path.glob("weights-*")).unlink()
    with pytest.raises(FileNotFoundError, match="names a file that is missing: weights-"):
        load_model(tmp_path)


def test_a_flipped_bit_in_the_weights_is_found(tmp_path: Path, model: TactileTransformer):
    save_model(tmp_path, model)
    path = next(tmp_path.glob("weights-*"))
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match="is damaged: its hash is not the one"):
        load_model(tmp_path)


def test_a_damaged_or_foreign_manifest_is_refused(tmp_path: Path, model: TactileTransformer):
    save_model(tmp_path, model)
    path = tmp_path / "manifest.json"
    whole = json.loads(path.read_text())
    for text, message in [
        ("{", "damaged or from another program"),
        ("[]", "damaged or from another program"),
        (
            json.dumps(whole | {"schema": "adaptfault.model/9"}),
            "has schema 'adaptfault.model/9', expected",
        ),
        (json.dumps({k: v for k, v in whole.items() if k != "weights"}), "is damaged"),
        (json.dumps(whole | {"config": whole["config"] | {"surprise": 1}}), "is damaged"),
        (
            json.dumps(whole | {"config": whole["config"] | {"n_classes": 5}}),
            "is damaged: Error.s. in loading state_dict",
        ),
    ]:
        path.write_text(text)
        with pytest.raises(ValueError, match=message) as error:
            load_model(tmp_path)
        assert "\n" not in str(error.value)


def test_what_json_cannot_hold_is_refused_before_anything_is_written(
    tmp_path: Path, model: TactileTransformer
):
    for extra in ({"x": float("nan")}, {"x": object()}):
        with pytest.raises(ValueError, match="cannot be written as JSON"):
            save_model(tmp_path, model, extra=extra)
    with pytest.raises(ValueError, match="3 classes need as many class names, got 1"):
        save_model(tmp_path, model, class_names=("a",))
    assert not list(tmp_path.iterdir())


def test_an_atomic_write_replaces_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "file"
    atomic_write(path, b"old")

    def fail(descriptor: int) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        with pytest.raises(OSError, match="disk full"):
            atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"


def test_a_model_comes_back_with_its_head_in_closed_form_and_without(tmp_path, versions):
    head = Adaptation.load(versions["head"]).model.head
    network = Adaptation.load(versions["whole"]).model.network
    save_model(tmp_path, network, head=head)
    plain = load_model(tmp_path)
    healthy = load_healthy(tmp_path)
    assert all(
        torch.equal(tensor, network.state_dict()[name])
        for name, tensor in plain.state_dict().items()
    )
    assert not len(healthy.fault_set)
    assert all(
        torch.equal(tensor, head.state_dict()[name])
        for name, tensor in healthy.model.head.state_dict().items()
    )
    save_model(tmp_path, network)
    assert load_healthy(tmp_path).model.head is None


def test_a_bundle_that_is_opened_as_a_model_is_named(tmp_path):
    (tmp_path / "bundle.json").write_text("{}")
    for read in (load_model, load_healthy):
        with pytest.raises(FileNotFoundError, match="is a bundle, not a model"):
            read(tmp_path)
