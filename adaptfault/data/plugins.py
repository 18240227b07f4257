"""Parts that other packages may add through entry points; those of this package are found without
an installation, too."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any


def plugins(group: str, built_in: Mapping[str, str]) -> dict[str, Any]:
    """Return what is registered in an entry point group, by its name.

    Args:
        group: of the entry points.
        built_in: module of each part of this package, in the order wanted. Another package replaces
            one by an entry point of the same name; its own parts come behind.

    Raises:
        ImportError: a part cannot be imported.
    """
    others = {
        entry.name: entry
        for entry in entry_points(group=group)
        if built_in.get(entry.name) != entry.value
    }
    found = {name: import_module(module) for name, module in built_in.items() if name not in others}
    loaded = {name: entry.load() for name, entry in others.items()}
    order = [*built_in, *(name for name in others if name not in built_in)]
    return {name: found.get(name, loaded.get(name)) for name in order}
