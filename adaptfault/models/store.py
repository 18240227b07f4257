"""Models on disk: a folder with weights (safetensors) and a manifest (JSON) with their hash. No
pickle."""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from adaptfault.data.atomic import atomic_write
from adaptfault.models.builders import ModelNotAllowed

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
_WEIGHTS = re.compile(r"weights-[0-9a-f]{12}\.safetensors")
_HEAD = "closed form head."  # begins the names of its tensors; no module's name holds a space


class Folder(Protocol):
    """Where a model is kept: on the disk, in the memory, or on the disk with recorded hashes."""

    def read(self, name: str) -> bytes:
        """Return the content of a file; raises FileNotFoundError where there is none."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Write a file in one step."""
        ...

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        ...


Place = str | PathLike[str] | Folder


@dataclass(frozen=True)
class _OnDisk:
    """A folder of the file system; made where missing."""

    path: Path

    def read(self, name: str) -> bytes:
        """Return the content of a file; raises FileNotFoundError."""
        path = self.path / name
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing")
        return path.read_bytes()

    def write(self, name: str, data: bytes) -> None:
        """Write a file in one step."""
        self.path.mkdir(parents=True, exist_ok=True)
        atomic_write(self.path / name, data)

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        (self.path / name).unlink(missing_ok=True)

    def __str__(self) -> str:
        return str(self.path)


class InMemory(dict[str, bytes]):
    """The files of a folder that is not on the disk yet, by name."""

    def read(self, name: str) -> bytes:
        """Return the content of a file; raises FileNotFoundError."""
        if name not in self:
            raise FileNotFoundError(f"{name} is missing")
        return self[name]

    def write(self, name: str, data: bytes) -> None:
        """Keep a file."""
        self[name] = data

    def remove(self, name: str) -> None:
        """Forget a file."""
        self.pop(name, None)

    def __str__(self) -> str:
        return "(not on the disk yet)"


def _folder(place: Place) -> Folder:
    return _OnDisk(Path(place)) if isinstance(place, str | PathLike) else place


def save_tensors(
    folder: Place, schema: str, about: Mapping[str, Any], tensors: Mapping[str, Tensor]
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
    folder: Place, schema: str, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
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


def _save(place: Place, schema: str, about: Mapping[str, Any], data: bytes) -> None:
    digest = hashlib.sha256(data).hexdigest()
    name = f"weights-{digest[:12]}.safetensors"
    manifest = {"schema": schema, **about, "weights": {"file": name, "sha256": digest}}
    try:
        text = json.dumps(manifest, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the manifest cannot be written as JSON: {error}") from None
    folder = _folder(place)
    before = _weights_of(folder)
    folder.write(name, data)
    folder.write(MANIFEST, text.encode())
    if before not in ("", name):
        folder.remove(before)


def _weights_of(folder: Folder) -> str:
    """Return the name of the file of tensors that the manifest of a folder names; "" without
    one."""
    try:
        name = str(_manifest(folder)["weights"]["file"])
    except (OSError, ValueError, TypeError, KeyError):
        return ""
    return name if _WEIGHTS.fullmatch(name) else ""


def schema_of(folder: Place) -> str:
    """Return the schema of the content of a folder.

    Raises:
        FileNotFoundError: there is no ``manifest.json``.
        ValueError: it is not JSON with a schema.
    """
    return str(_manifest(_folder(folder))["schema"])


def read_manifest(folder: Place, schema: str) -> dict[str, Any]:
    """Return the content of ``manifest.json``. Needs no torch.

    Raises:
        FileNotFoundError: there is none in the folder.
        ValueError: it is not JSON, or of another schema.
    """
    manifest = _manifest(_folder(folder))
    if manifest["schema"] != schema:
        raise ValueError(
            f"{folder}/{MANIFEST} has schema {manifest['schema']!r}, expected {schema!r}"
        )
    return manifest


def _manifest(folder: Folder) -> dict[str, Any]:
    path = f"{folder}/{MANIFEST}"
    try:
        data = folder.read(MANIFEST)
    except FileNotFoundError:
        if isinstance(folder, _OnDisk) and (folder.path / _BUNDLE).is_file():
            raise FileNotFoundError(
                f"{folder} is a bundle, not a model: Bundle.open({str(folder)!r}).adapter() has its"
                " model, and its healthy adaptation"
            ) from None
        what = f"{folder}: expected a folder with a {MANIFEST}, found none"
        raise FileNotFoundError(what) from None
    try:
        manifest = json.loads(data)
        manifest["schema"]
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ValueError(
            f"{path} is damaged or from another program: expected JSON with a schema"
        ) from None
    return dict(manifest)


def load_tensors(folder: Place, schema: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read what :func:`save_tensors` wrote.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or of another schema.
    """
    from safetensors.torch import load

    manifest, data = _load(folder, schema)
    return manifest, load(data)


def load_arrays(folder: Place, schema: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read what :func:`save_arrays` wrote; raises what :func:`load_tensors` raises. Needs no
    torch."""
    from safetensors.numpy import load

    manifest, data = _load(folder, schema)
    return manifest, load(data)


def _load(folder: Place, schema: str) -> tuple[dict[str, Any], bytes]:
    manifest = read_manifest(folder, schema)
    return manifest, read_attached(folder, manifest, "weights")


def attach(place: Place, key: str, name: str, data: bytes) -> None:
    """Write one more file into a folder with a manifest, and add its hash to the manifest as
    ``key``.

    Raises:
        FileNotFoundError: there is no ``manifest.json``.
        ValueError: it is damaged.
    """
    folder = _folder(place)
    manifest = {
        **_manifest(folder),
        key: {"file": name, "sha256": hashlib.sha256(data).hexdigest()},
    }
    folder.write(name, data)
    folder.write(MANIFEST, json.dumps(manifest, indent=1, allow_nan=False).encode())


def read_attached(place: Place, manifest: Mapping[str, Any], key: str) -> bytes:
    """Return the content of the file that a manifest lists as ``key``. Needs no torch.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the hash differs, or the manifest lists no such file.
    """
    folder = _folder(place)
    try:
        name = Path(manifest[key]["file"]).name  # a manifest cannot point outside its folder
        digest = manifest[key]["sha256"]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{folder}/{MANIFEST} is damaged: {error}") from None
    try:
        data = folder.read(name)
    except FileNotFoundError:
        what = f"{folder}/{MANIFEST} names a file that is missing: {name}"
        raise FileNotFoundError(what) from None
    if hashlib.sha256(data).hexdigest() != digest:
        raise ValueError(f"{folder}/{name} is damaged: its hash is not the one in {MANIFEST}")
    return data


def save_model(
    folder: Place,
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
    check_names(class_names, model.n_classes, task)
    check_rebuildable(model.config)
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


def check_names(names: Sequence[str], n: int, task: str) -> None:
    """Raise ValueError where there are names, and not one for each of n classes or values."""
    if names and len(names) != n:
        many, one = ("values", "value") if task == "regression" else ("classes", "class")
        raise ValueError(f"{n} {many} need as many {one} names, got {len(names)}")


def check_rebuildable(config: Mapping[str, Any]) -> None:
    """Raise ValueError where the model of a configuration is a module without a builder."""
    if "module" in config and config["builder"] is None:
        raise ValueError(
            f"{config['module']} cannot be rebuilt from a file: make it with"
            " build_model('package.module:function', layout, n_classes)"
        )


@contextmanager
def undamaged(what: str, folder: Place) -> Iterator[None]:
    """Raise ValueError for any error in decoding what a folder holds."""
    try:
        yield
    except ModelNotAllowed:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError, zlib.error) as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"the {what} in {folder} is damaged: {first}") from None


def load_model(folder: Place) -> TactileTransformer | AnyModel:
    """Read the model that :func:`save_model` wrote, in eval mode, without the head in closed form.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, the weights do not fit the network, or its builder is not
            allowed.
    """
    return load_with_head(folder)[0]


def load_with_head(folder: Place) -> tuple[TactileTransformer | AnyModel, Head | None]:
    """Read the model that :func:`save_model` wrote, and its head in closed form if it has one.

    Raises the errors of :func:`load_model`.
    """
    from adaptfault.models.any_model import network_from_config
    from adaptfault.models.heads import Head

    manifest, tensors = load_tensors(folder, SCHEMA)
    with undamaged("model", folder):
        model = network_from_config(manifest["config"])
        head = None
        if (about := manifest.get("head")) is not None:
            head = Head.empty(about, model.n_classes)
            head.load_state_dict(
                {k.removeprefix(_HEAD): v for k, v in tensors.items() if k.startswith(_HEAD)}
            )
        model.load_state_dict({k: v for k, v in tensors.items() if not k.startswith(_HEAD)})
    return model.eval(), head
