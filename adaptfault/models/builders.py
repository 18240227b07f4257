"""Models that a function of the user builds: stored by the import path of the function, never as
code or pickle.

Opening a stored model imports and calls this function, so its import path must be allowed first.
"""

from __future__ import annotations

import os
import re
from importlib import import_module
from typing import TYPE_CHECKING

from diagnostics import SensorLayout

if TYPE_CHECKING:
    from torch import nn

VARIABLE = (  # environment variable with allowed import paths, separated by commas
    "ADAPTFAULT_MODELS"
)
_PATH = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
_allowed: set[str] = set()


class ModelNotAllowed(ValueError):
    """A stored model names a builder that is not allowed, or that cannot be used."""


def allow_model(builder: str) -> None:
    """Allow stored models to be built by the function ``package.module:function`` in this process.

    The environment variable ``ADAPTFAULT_MODELS`` lists import paths that are allowed in each
    process.

    Raises:
        ValueError: ``builder`` is no such import path.
    """
    if not _PATH.fullmatch(builder):
        raise ValueError(f"expected an import path package.module:function, got {builder!r}")
    _allowed.add(builder)


def build_model(
    builder: str, layout: SensorLayout, n_classes: int, *, length: int = 10
) -> nn.Module:
    """Return ``builder(layout, n_classes, length)``, a module that can be stored by its import
    path.

    Args:
        builder: import path ``package.module:function``, allowed by :func:`allow_model`.
        layout: the array.
        n_classes: number of outputs.
        length: frames in a window.

    Raises:
        ValueError: the builder is not allowed, cannot be imported, fails, or returns no torch
            module.
    """
    from torch import nn

    if builder not in _allowed | set(os.environ.get(VARIABLE, "").replace(" ", "").split(",")):
        raise ModelNotAllowed(
            f"the model is built by {builder!r}, which is not allowed: call"
            f" allow_model({builder!r}) or set {VARIABLE}"
        )
    if not _PATH.fullmatch(builder):
        raise ModelNotAllowed(f"expected an import path package.module:function, got {builder!r}")
    module, name = builder.split(":")
    try:
        function = getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ModelNotAllowed(
            f"the builder {builder!r} cannot be imported ({error}): install its package or set"
            " PYTHONPATH"
        ) from None
    try:
        model = function(layout, n_classes, length)
    except Exception as error:  # a builder may raise anything
        raise ModelNotAllowed(
            f"the builder {builder!r} fails: {first_line(error)}; it is called with (layout,"
            " n_classes, length)"
        ) from error
    if not isinstance(model, nn.Module):
        raise ModelNotAllowed(
            f"the builder {builder!r} returned {type(model).__name__}, expected a torch.nn.Module"
        )
    model.__dict__["adaptfault_builder"] = builder
    return model


def builder_of(model: nn.Module) -> str | None:
    """Return the import path of the builder of a module; None for one that was built otherwise."""
    builder: str | None = model.__dict__.get("adaptfault_builder")
    return builder


def first_line(error: Exception) -> str:
    """Return the first line of the message of an error, or its class where it has none."""
    return (str(error) or repr(error)).splitlines()[0]
