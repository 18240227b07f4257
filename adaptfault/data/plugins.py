"""Parts that other packages may add through entry points, and those that are installed on their
own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

APART = {
    "adaptfault.acquisition": "adaptfault-station",
    "adaptfault.cli.export_monitor": "adaptfault-firmware",
    "adaptfault.cli.fleet": "adaptfault-fleet",
    "adaptfault.cli.listen": "adaptfault-station",
    "adaptfault.cli.reproduce": "adaptfault-paper",
    "adaptfault.cli.view": "adaptfault-viewers",
    "adaptfault.firmware": "adaptfault-firmware",
    "adaptfault.fleet": "adaptfault-fleet",
    "adaptfault.prognosis": "adaptfault-prognosis",
    "adaptfault.viewers": "adaptfault-viewers",
}
"""The package that brings a module, where it is installed on its own."""


def what_to_install(error: BaseException) -> str | None:
    """Return one line that says which package is missing; None: it is another error."""
    package = APART.get(error.name or "") if isinstance(error, ModuleNotFoundError) else None
    if package is None:
        return None
    return f"this needs {package}, which is not installed: pip install {package}"


def plugins(group: str, built_in: Mapping[str, str], only: str | None = None) -> dict[str, Any]:
    """Return what is registered in an entry point group, by its name; an :class:`Apart` stands for
    what is not installed.

    Args:
        group: of the entry points.
        built_in: module of each part of the repository, in the order wanted; they are found without
            their entry points, too. Another package replaces one by an entry point of the same
            name; its own parts come behind.
        only: name of the part that is wanted; None, or one that is not registered: all.

    Raises:
        ImportError: a part cannot be imported.
    """
    others = {
        name: entry
        for name, entry in _registered(group).items()
        if built_in.get(name) != entry.value
    }
    names = list(dict.fromkeys([*built_in, *others]))
    wanted = [only] if only in names else names
    return {
        name: others[name].load() if name in others else _part(name, built_in[name])
        for name in wanted
    }


def _registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by their names."""
    return {entry.name: entry for entry in _entry_points() if entry.group == group}


@cache
def _entry_points() -> tuple[EntryPoint, ...]:
    """Return those of our groups; to look for them, each package that is installed is opened."""
    known = entry_points()
    return tuple(
        entry
        for group in known.groups
        if group.startswith("adaptfault.")
        for entry in known.select(group=group)
    )


def _part(name: str, module: str) -> Any:
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module or module not in APART:
            raise
        return Apart(name, module)


@dataclass(frozen=True)
class Apart:
    """A command of a package that is not installed: it takes any arguments and says what to
    install."""

    name: str
    module: str

    def add(self, commands: Any) -> None:
        """Add the command."""
        summary = f"needs: pip install {APART[self.module]}"
        # no argument begins with this character, so that each is taken as it is
        parser = commands.add_parser(self.name, help=summary, add_help=False, prefix_chars="\0")
        parser.add_argument("arguments", nargs="*")
        parser.set_defaults(run=self.run)

    def run(self, args: Any) -> int:
        """Raise ModuleNotFoundError."""
        import_module(self.module)
        return 0
