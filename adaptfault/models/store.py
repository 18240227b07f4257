"""Models on disk: a folder with weights (safetensors) and a manifest (JSON) with their hash. No
pickle."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from adaptfault.data.atomic import atomic_write

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.heads import Head
    from adaptfault.models.network import TactileTransformer

SCHEMA = "adaptfault.model/1"
ADAPTATION = "adaptfault.adaptation/1"  # schema of an adapted model
MANIFEST = "manifest.json"
_BUNDLE = "bundle.json"  # a folder with one holds models, and is none
_HEAD = "closed form head."  # begins the names of its tensors; no module's name holds a space


def save_tensors(
    folder: str | Path, schema: str, about: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write tensors and a manifest into a folder; the folder is created, and earlier content is
    replaced.

    The tensors go to a file named by their hash, and ``manifest.json`` names that file. Replacing
    the manifest switches from the old content to the new in one step.

    Raises:
        ValueError: ``about`` does not fit into JSON.
    """
    from safetensors.torch import save

    # Copies: safetensors refuses tensors that share memory or are not contiguous.
    _save(
        folder,
        schema,
        about,
        save({k: tensor.detach().cpu().clone().contiguous() for k, tensor in tensors.items()}),
    )


def save_arrays(
    folder: str | Path, schema: str, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write arrays as :func:`save_tensors` writes tensors. Needs no torch.

    Raises:
        ValueError: ``about`` does not fit into JSON.
    """
    from safetensors.numpy import save

    _save(
        folder,
        schema,
        about,
        save({name: np.ascontiguousarray(array) for name, array in arrays.items()}),
    )


def _save(folder: str | Path, schema: str, about: Mapping[str, Any], data: bytes) -> None:
    digest = hashlib.sha256(data).hexdigest()
    name = f"weights-{digest[:12]}.safetensors"
    manifest = {"schema": schema, **about, "weights": {"file": name, "sha256": digest}}
    try:
        text = json.dumps(manifest, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the manifest cannot be written as JSON: {error}") from None
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(folder / name, data)
    atomic_write(folder / MANIFEST, text.encode())
    for old in folder.glob("weights-*.safetensors"):
        if old.name != name:
            old.unlink(missing_ok=True)


def schema_of(folder: str | Path) -> str:
    """Return the schema of the content of a folder.

    Raises:
        FileNotFoundError: there is no ``manifest.json``.
        ValueError: it is not JSON with a schema.
    """
    return str(_manifest(Path(folder))["schema"])


def read_manifest(folder: str | Path, schema: str) -> dict[str, Any]:
    """Return the content of ``manifest.json``. Needs no torch.

    Raises:
        FileNotFoundError: there is none in the folder.
        ValueError: it is not JSON, or of another schema.
    """
    manifest = _manifest(Path(folder))
    if manifest["schema"] != schema:
        raise ValueError(
            f"{Path(folder) / MANIFEST} has schema {manifest['schema']!r}, expected {schema!r}"
        )
    return manifest


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    if not path.is_file():
        if (folder / _BUNDLE).is_file():
            raise FileNotFoundError(
                f"{folder} is a bundle, not a model: Bundle.open({str(folder)!r}).adapter() has its"
                " model, and its healthy adaptation"
            )
        raise FileNotFoundError(f"{folder}: expected a folder with a {MANIFEST}, found none")
    try:
        manifest = json.loads(path.read_bytes())
        manifest["schema"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ValueError(
            f"{path} is damaged or from another program: expected JSON with a schema"
        ) from None
    return dict(manifest)


def load_tensors(folder: str | Path, schema: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read what :func:`save_tensors` wrote.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or of another schema.
    """
    from safetensors.torch import load

    manifest, data = _load(Path(folder), schema)
    return manifest, load(data)


def load_arrays(folder: str | Path, schema: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read what :func:`save_arrays` wrote; raises what :func:`load_tensors` raises. Needs no
    torch."""
    from safetensors.numpy import load

    manifest, data = _load(Path(folder), schema)
    return manifest, load(data)


def _load(folder: Path, schema: str) -> tuple[dict[str, Any], bytes]:
    manifest = read_manifest(folder, schema)
    return manifest, read_attached(folder, manifest, "weights")


def attach(folder: str | Path, key: str, name: str, data: bytes) -> Path:
    """Write one more file into a folder with a manifest, add its hash to the manifest as ``key``,
    return its path.

    Raises:
        FileNotFoundError: there is no ``manifest.json``.
        ValueError: it is damaged.
    """
    folder = Path(folder)
    manifest = {
        **_manifest(folder),
        key: {"file": name, "sha256": hashlib.sha256(data).hexdigest()},
    }
    atomic_write(folder / name, data)
    atomic_write(folder / MANIFEST, json.dumps(manifest, indent=1, allow_nan=False).encode())
    return folder / name


def read_attached(folder: str | Path, manifest: Mapping[str, Any], key: str) -> bytes:
    """Return the content of the file that a manifest lists as ``key``. Needs no torch.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the hash differs, or the manifest lists no such file.
    """
    folder = Path(folder)
    try:
        name = manifest[key]["file"]
        digest = manifest[key]["sha256"]
        path = folder / Path(name).name  # a manifest cannot point outside its folder
    except (KeyError, TypeError) as error:
        raise ValueError(f"{folder / MANIFEST} is damaged: {error}") from None
    if not path.is_file():
        raise FileNotFoundError(f"{folder / MANIFEST} names a file that is missing: {name}")
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != digest:
        raise ValueError(f"{path} is damaged: its hash is not the one in {MANIFEST}")
    return data


def save_model(
    folder: str | Path,
    model: TactileTransformer | AnyModel,
    *,
    class_names: Sequence[str] = (),
    extra: Mapping[str, Any] | None = None,
    head: Head | None = None,
    task: Literal["classification", "regression"] = "classification",
) -> None:
    """Write a model into a folder; an earlier model there is replaced in one step.

    Args:
        folder: the folder to write.
        model: saved as weights and :attr:`~adaptfault.models.network.TactileTransformer.config`.
        class_names: one name a class, or a value of a regression; or none.
        extra: JSON-safe values to store beside the model.
        head: fitted in closed form to the healthy model, for :func:`~adaptfault.load_healthy`;
            None: the model has its own alone.
        task: "classification" or "regression".

    Raises:
        ValueError: another number of names than classes or values, a module without builder, or
            ``extra`` does not fit into JSON.
    """
    if class_names and len(class_names) != model.n_classes:
        kinds = ("values", "value") if task == "regression" else ("classes", "class")
        raise ValueError(
            f"{model.n_classes} {kinds[0]} need as many {kinds[1]} names, got {len(class_names)}"
        )
    if "module" in model.config and model.config["builder"] is None:
        raise ValueError(
            f"{model.config['module']} cannot be rebuilt from a file: make it with"
            " build_model('package.module:function', layout, n_classes)"
        )
    about = {
        "config": model.config,
        "task": task,
        "class_names": list(class_names),
        "extra": dict(extra or {}),
    }
    tensors = dict(model.state_dict())
    if head is not None:
        about["head"] = head.about
        tensors |= {_HEAD + name: tensor for name, tensor in head.state_dict().items()}
    save_tensors(folder, SCHEMA, about, tensors)


def load_model(folder: str | Path) -> TactileTransformer | AnyModel:
    """Read the model that :func:`save_model` wrote, in eval mode, without the head in closed form.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, the weights do not fit the network, or its builder is not
            allowed.
    """
    return load_with_head(folder)[0]


def load_with_head(folder: str | Path) -> tuple[TactileTransformer | AnyModel, Head | None]:
    """Read the model that :func:`save_model` wrote, and its head in closed form if it has one.

    Raises the errors of :func:`load_model`.
    """
    from adaptfault.models.any_model import network_from_config
    from adaptfault.models.builders import ModelNotAllowed
    from adaptfault.models.heads import Head

    manifest, tensors = load_tensors(folder, SCHEMA)
    try:
        model = network_from_config(manifest["config"])
        head = None
        if (about := manifest.get("head")) is not None:
            head = Head.empty(about, model.n_classes)
            head.load_state_dict(
                {k.removeprefix(_HEAD): v for k, v in tensors.items() if k.startswith(_HEAD)}
            )
        model.load_state_dict({k: v for k, v in tensors.items() if not k.startswith(_HEAD)})
    except ModelNotAllowed:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"the model in {folder} is damaged: {str(error).splitlines()[0]}"
        ) from None
    return model.eval(), head
