"""Renders self-contained HTML pages: pictures are embedded, no network is needed."""

from __future__ import annotations

import base64
import io
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import adaptfault
from adaptfault.data.atomic import atomic_write
from diagnostics.decision.coverage import percent
from diagnostics.decision.plot import PAGE, legend_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NARROW = 4.5
"""Width of a page on a telephone, in inches: its letters are then legible."""


def render(
    path: str | Path, template: str, *, packages: Sequence[str] = ("adaptfault",), **values: Any
) -> Path:
    """Render a template, named by its room and its file, into a file, with the versions of
    packages; return the path.

    Raises:
        OSError: the folder cannot be written.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    rooms = FileSystemLoader(list(adaptfault.__path__))
    environment = Environment(loader=rooms, autoescape=True, undefined=StrictUndefined)
    environment.filters["percent"] = percent
    environment.filters["legend"] = legend_of
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    values["versions"] = ", ".join(f"{name} {version_of(name)}" for name in packages)
    values["python"] = platform.python_version()
    atomic_write(path, environment.get_template(template).render(values).encode())
    return path


@dataclass(frozen=True)
class Picture:
    """A figure for wide and for narrow screens, as data URIs of PNGs.

    Attributes:
        wide: the figure.
        narrow: the same with the pads below each other; empty where it is narrow already.
    """

    wide: str
    narrow: str

    @classmethod
    def of(cls, plot: Callable[[float], Figure]) -> Picture:
        """Draw the figure with ``plot``, a function of the width of the page in inches."""
        wide = plot(PAGE)
        return cls(
            _embedded(wide), _embedded(plot(_NARROW)) if wide.get_figwidth() > _NARROW else ""
        )


def _embedded(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def version_of(package: str) -> str:
    """Return the installed version of a package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"
