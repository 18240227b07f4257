"""A training run on disk: tensors and JSON in one safetensors file, valid for one set of training
settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from adaptfault.data.atomic import atomic_write
from adaptfault.data.windows import Windows

SCHEMA = "adaptfault.training/1"


def write_checkpoint(
    path: Path,
    tensors: Mapping[str, Tensor],
    *,
    settings: Mapping[str, Any],
    state: Mapping[str, Any],
) -> None:
    """Write a checkpoint; a crash at any moment leaves the earlier one.

    Args:
        path: the file.
        tensors: contiguous tensors that share no memory.
        settings: must be equal for a run to continue; JSON-safe.
        state: progress of the run; JSON-safe.
    """
    about = {"schema": SCHEMA, "settings": _json(settings), "state": _json(state)}
    atomic_write(path, save({name: tensor.cpu() for name, tensor in tensors.items()}, about))


def read_checkpoint(
    path: Path, settings: Mapping[str, Any]
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and state of a checkpoint.

    Raises:
        ValueError: the file is damaged or no checkpoint, or the settings differ; the message names
            them.
    """
    mend = "delete it or give another path"
    try:
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
            if about.get("schema") != SCHEMA:
                raise ValueError(f"{path} is not a training checkpoint of this version: {mend}")
            if about["settings"] != _json(settings):
                was = json.loads(about["settings"])
                changed = sorted(
                    name for name in {*settings, *was} if settings.get(name) != was.get(name)
                )
                raise ValueError(
                    f"checkpoint {path} is of a run with another {', '.join(changed)}: {mend}"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
            return tensors, json.loads(about["state"])
    except SafetensorError as error:
        raise ValueError(f"{path} is not a whole checkpoint ({error}): {mend}") from None


def fingerprint_windows(*windows: Windows) -> str:
    """Hash windows and their labels."""
    digest = hashlib.blake2b(digest_size=16)
    for w in windows:
        digest.update(str(w.x.shape).encode())
        digest.update(np.ascontiguousarray(w.x).data)
        digest.update(np.ascontiguousarray(w.y).data)
        for name, values in w.extra.items():
            digest.update(f"{name} {values.shape}".encode())
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def fingerprint_weights(model: nn.Module) -> str:
    """Hash a model's weights, their names, and which of them are trainable."""
    digest = hashlib.blake2b(digest_size=16)
    trained = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    for name, tensor in model.state_dict().items():
        digest.update(f"{name} {tuple(tensor.shape)} {name in trained}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(dict(value), sort_keys=True, allow_nan=False)
