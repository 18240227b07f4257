"""Renders self-contained HTML pages: pictures are embedded, no network is needed."""

from __future__ import annotations

import base64
import io
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.data.atomic import atomic_write
from diagnostics.decision.coverage import percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def render(path: str | Path, template: str, **values: Any) -> Path:
    """Render a template of the package into a file; return the path.

    Raises:
        OSError: the folder cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("adaptfault.evaluation"), autoescape=True, undefined=StrictUndefined)
    environment.filters["percent"] = percent
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, environment.get_template(template).render(values).encode())
    return path


def embedded(figure: Figure) -> str:
    """Return a figure as a data URI of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def version_of(package: str) -> str:
    """Return the installed version of a package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"
