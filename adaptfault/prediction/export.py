"""Exports an adapted model to one ONNX file, from whole windows to outputs, and compares the file
with the model."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault import __version__
from adaptfault.adaptation.reduced_model import ReducedModel
from adaptfault.adaptation.result import Adaptation
from adaptfault.models.any_model import AnyModel
from adaptfault.models.builders import first_line
from adaptfault.models.compact import CompactNetwork
from adaptfault.models.heads import Head
from adaptfault.models.network import TactileTransformer
from adaptfault.models.store import Place, attach
from adaptfault.prediction.inference import ONNX_FILE, open_session, run_session
from adaptfault.prediction.whole_windows import Masked, Selected
from diagnostics import FaultSet

TOLERANCE = 1e-5  # of a probability; of a value, in units of the largest one

_EXAMPLE = 2  # windows in the batch of the export
_LOGS = ("torch.onnx._internal.exporter._registration", "torch.fx.experimental.symbolic_shapes")
_BATCHES = (1, 7)  # of the comparison: an export with a fixed batch size raises no error by itself


class ExportError(RuntimeError):
    """The export failed, or the outputs of the exported file differ from the outputs of the
    model."""


def add_onnx(folder: Place, graph: bytes | None = None) -> Path:
    """Export the adaptation that :meth:`Adaptation.save` wrote into ``folder``, and return the new
    file's path.

    The file lies beside the weights, and ``manifest.json`` states its hash. Do not call it on a
    folder that a robot is running from: a power cut between the two writes leaves a file that does
    not match its hash.

    Args:
        folder: with the adaptation.
        graph: of the network with a head in closed form, as a bundle holds it
            (``bundle.parts.graph``); it saves the seconds of a new export. One that does not fit
            has no effect.

    Raises:
        ExportError: the export failed, or the outputs differ from the model.
        ImportError: the packages for the export are not installed.
        FileNotFoundError, ValueError: there is no whole adaptation in the folder.
    """
    adaptation = Adaptation.load(folder)
    data = to_onnx(adaptation.model, graph, values=adaptation.task == "regression")
    attach(folder, "onnx", ONNX_FILE, data)
    return Path(str(folder), ONNX_FILE)


def to_onnx(model: ReducedModel, graph: bytes | None = None, *, values: bool = False) -> bytes:
    """Return a model as the content of an ONNX file.

    The input ``x`` is a batch of whole windows, float32 ``[N, T, D]`` on the 0..1 scale, any N. The
    output ``probabilities`` is float32 ``[N, n_classes]``; of a regression it is ``values``
    ``[N, k]``. The paper's network is stored in its
    low-rank form (:mod:`adaptfault.models.compact`). The file is run on batches of 1 and 7 windows;
    its outputs agree with the model within 1e-5.

    The file's ``metadata_props`` state what it is: ``adaptfault.layout`` (SHA-256 of the layout as
    JSON with sorted keys), ``adaptfault.fault_set`` (JSON list of cells), ``adaptfault.task`` and
    ``adaptfault.version``. The same model gives the same file.

    Args:
        model: adapted to any F.
        graph: of :func:`graph_of`, for the same network: a new file takes a second with it. One
            that does not fit the model has no effect.
        values: the model is a regression.

    Raises:
        ExportError: the export failed, or the outputs differ.
        ImportError: the packages for it are not installed.
    """
    model = copy.deepcopy(model).cpu().eval()
    whole = _whole(model, values)
    if graph is not None:
        with suppress(ExportError):
            data = _described(_with_state(graph, whole), model, values)
            _verify(data, model, values)
            return data
    data = _translate(whole, torch.from_numpy(_probes(model, _EXAMPLE)), values)
    data = _described(data, model, values)
    _verify(data, model, values)
    return data


def graph_of(network: TactileTransformer | AnyModel, *, values: bool = False) -> bytes:
    """Return the ONNX graph of a network with a head in closed form, without the state, for
    :func:`to_onnx`; ``values`` as there.

    Raises the errors of :func:`to_onnx`.
    """
    none = FaultSet((), network.layout.n_cells)
    model = ReducedModel(copy.deepcopy(network).cpu(), none, None).eval()
    with torch.no_grad():
        views = model.views(torch.from_numpy(_probes(model, _EXAMPLE)))
    model.head = Head.blank(views, network.n_classes, network.layout.n_cells, values=values)
    whole = _whole(model, values)
    return _stripped(_translate(whole, torch.from_numpy(_probes(model, _EXAMPLE)), values), whole)


def _whole(model: ReducedModel, values: bool = False) -> nn.Module:
    compact = _compacted(model)
    kind = Masked if Masked.suits(compact) else Selected
    return kind(compact, values=values).eval()


def _compacted(model: ReducedModel) -> ReducedModel:
    """Return the model with its network in low-rank form, where the network has one."""
    if not isinstance(model.network, TactileTransformer) or not CompactNetwork.suits(model.network):
        return model
    compact = copy.deepcopy(model)
    compact.add_module("network", CompactNetwork(model.network))
    return compact


def _translate(whole: nn.Module, example: Tensor, values: bool) -> bytes:
    """Return the ONNX file of a module, its parameters and buffers under their own names."""
    _require("onnxscript")  # torch's exporter needs it
    with _quiet():
        try:
            program = torch.onnx.export(
                whole,
                (example,),
                dynamo=True,
                dynamic_shapes=({0: torch.export.Dim.DYNAMIC},),
                input_names=["x"],
                output_names=["values" if values else "probabilities"],
                verbose=False,
                # it folds parameters into new constants; ONNX Runtime optimises what it opens
                optimize=False,
            )
        except torch.onnx.OnnxExporterError as error:
            # names the operation
            cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
            raise ExportError(f"the model could not be exported: {first_line(cause)}") from error
    assert program is not None  # with dynamo, and no file named, it is returned
    data: bytes = program.model_proto.SerializeToString()
    return data


def _require(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError:
        raise ImportError(
            "the export to ONNX needs more packages: pip install 'adaptfault[deploy]'"
        ) from None


def _stripped(data: bytes, whole: nn.Module) -> bytes:
    """Return an ONNX file without the parameters and buffers of a module."""
    onnx = _require("onnx")
    graph = onnx.load_from_string(data)
    state = whole.state_dict()
    for tensor in graph.graph.initializer:
        if tensor.name in state:
            tensor.CopyFrom(
                onnx.TensorProto(name=tensor.name, data_type=tensor.data_type, dims=[0])
            )
    del graph.graph.value_info[:]  # shapes of the example
    for node in graph.graph.node:
        del node.metadata_props[:]  # where in the code it comes from
    stripped: bytes = graph.SerializeToString()
    return stripped


def _with_state(data: bytes, whole: nn.Module) -> bytes:
    """Return an ONNX file with the parameters and buffers of a module that has its structure."""
    onnx = _require("onnx")
    graph = onnx.load_from_string(data)
    state = whole.state_dict()
    for tensor in graph.graph.initializer:
        if list(tensor.dims) == [0]:
            if tensor.name not in state:
                raise ExportError(
                    f"the graph is of another kind of model: this one has no {tensor.name}"
                )
            tensor.CopyFrom(onnx.numpy_helper.from_array(state[tensor.name].numpy(), tensor.name))
    whole_file: bytes = graph.SerializeToString()
    return whole_file


def _described(data: bytes, model: ReducedModel, values: bool) -> bytes:
    """Return an ONNX file whose ``metadata_props`` state layout, F, task and version."""
    onnx = _require("onnx")
    graph = onnx.load_from_string(data)
    layout = json.dumps(model.network.layout.to_dict(), sort_keys=True, allow_nan=False)
    facts = {
        "adaptfault.layout": hashlib.sha256(layout.encode()).hexdigest(),
        "adaptfault.fault_set": json.dumps(sorted(int(cell) for cell in model.fault_set)),
        "adaptfault.task": "regression" if values else "classification",
        "adaptfault.version": __version__,
    }
    others = [entry for entry in graph.metadata_props if entry.key not in facts]
    stated = [onnx.StringStringEntryProto(key=key, value=facts[key]) for key in facts]
    del graph.metadata_props[:]
    graph.metadata_props.extend([*others, *stated])
    described: bytes = graph.SerializeToString()
    return described


def _verify(data: bytes, model: ReducedModel, values: bool) -> None:
    """Run the file on batch sizes other than that of the export, and compare its outputs with the
    model."""
    whole = Selected(model, values=values).eval()
    try:
        session = open_session(data)
    except ValueError as error:
        raise ExportError(str(error)) from None
    probes = [_probes(model, n) for n in _BATCHES]
    with torch.no_grad():
        outputs = [whole(torch.from_numpy(x)).numpy() for x in probes]
    largest = np.abs(np.concatenate(outputs)).max(axis=0) if values else np.float32(1.0)
    for x, expected in zip(probes, outputs, strict=True):
        n = len(x)
        try:
            given = run_session(session, x)
        except Exception as error:  # ONNX Runtime has its own kinds, all straight from Exception
            raise ExportError(
                f"the exported file does not run on {n} windows: {str(error).splitlines()[0]}"
            ) from None
        same = given.shape == expected.shape
        if not same or not (np.abs(given - expected) <= TOLERANCE * largest).all():
            raise ExportError(
                f"the outputs of the exported file differ from the model on {n} windows: the file"
                " is not used"
            )


def _probes(model: ReducedModel, n: int) -> NDArray[np.float32]:
    """Draw windows ``[n, T, D]``: half of the cells at 0, NaN or infinity in the dropped cells."""
    network = model.network
    rng = np.random.default_rng(n)
    shape = (n, network.length, network.layout.n_cells)
    x = np.where(rng.random((n, 1, shape[2])) < 0.5, rng.random(shape) ** 2, 0.0).astype(np.float32)
    x[..., model.fault_set.mask] = np.where(rng.random(n) < 0.5, np.nan, np.inf)[:, None, None]
    return x


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter: its own deprecated calls and optional packages, and the graph of what
    it cannot export."""
    logs = [logging.getLogger(name) for name in _LOGS]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), redirect_stderr(io.StringIO()):
            warnings.filterwarnings(
                "ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning
            )
            yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)
