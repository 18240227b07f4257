"""Sphinx: the pages of this folder, and the reference made from the docstrings. ``make docs``
builds the site."""

from __future__ import annotations

import importlib
import re
from functools import cache
from importlib.metadata import version as version_of
from typing import Any

from docutils.nodes import Element, TextElement
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.domains.python import PyObject
from sphinx.environment import BuildEnvironment
from sphinx.ext.autodoc.mock import mock, undecorate
from sphinx.util import logging

PUBLIC = ("adaptfault", "diagnostics")

project = "adaptfault"
author = copyright = "The adaptfault developers"
version = release = version_of("adaptfault")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
templates_path = ["templates"]
highlight_language = "text"  # of blocks that do not say
exclude_patterns = ["templates", "figures"]
html_static_path = ["static"]
html_css_files = ["width.css"]
html_theme = "furo"
html_title = f"adaptfault {version}"
html_show_sourcelink = False
html_show_copyright = False

myst_heading_anchors = 3

# The node and the step are described where neither ROS 2 nor LeRobot is installed, too.
autodoc_mock_imports = ["diagnostic_msgs", "lerobot", "rcl_interfaces", "rclpy"]
autodoc_default_options = {"members": True, "member-order": "bysource"}
# Show the names of these aliases, not the types behind them, which fill half a page.
autodoc_type_aliases = {
    "NDArray": "NDArray",
    "ArrayLike": "ArrayLike",
    "StateArrays": "StateArrays",
}
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature above has the types

# An unknown name of these packages is an error; other projects' pages are not available when the
# site is built.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!adaptfault\.|diagnostics\.).*"),
    (r"py:.*", r".*\._\w+"),
    (r"py:.*", r".*\.(Result|T)"),  # type variables
]
suppress_warnings = ["ref.python"]  # two modules may have a class of one name


# Pages whose source lies elsewhere, so that links work in the repository as well as on the site.
ELSEWHERE = {
    f"../examples/paper/{name}/README.md": f"paper/{name}.md" for name in ("simulated", "real")
}


def follow_elsewhere(app: Sphinx, page: str, source: list[str]) -> None:
    """Make links to these pages links within the site."""
    for there, here in ELSEWHERE.items():
        source[0] = source[0].replace(f"]({there})", f"]({here})")


def missing_names(app: Sphinx, env: BuildEnvironment) -> None:
    """Warn of each public name that the reference lacks; ``make docs`` takes warnings for
    errors."""
    documented = env.get_domain("py").objects
    for package in PUBLIC:
        for name in names_of(package):
            if f"{package}.{name}" not in documented:
                logging.getLogger(__name__).warning(
                    "%s.%s is public, but on no page of docs/api", package, name
                )


def names_of(package: str) -> list[str]:
    """Return the public names of a package, with those that other packages bring."""
    module = importlib.import_module(package)
    return sorted({*module.__all__, *getattr(module, "_HOMES", ())})


def public_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: TextElement
) -> Element | None:
    """Resolve a name of a module, ``FaultSet`` or ``adaptfault.models.store.save_model``, to the
    public one."""
    domain = env.get_domain("py")
    parts = node.get("reftarget", "").split(".")
    for package in PUBLIC if node.get("refdomain") == "py" else ():
        for full in (f"{package}.{parts[-1]}", ".".join([package, *parts[-2:]])):
            if full in domain.objects:
                return domain.resolve_xref(
                    env, node["refdoc"], app.builder, "obj", full, node, content
                )
    return None


def described_elsewhere(
    app: Sphinx, what: str, name: str, thing: Any, skip: bool, options: Any
) -> bool | None:
    """Skip public names on the pages of modules, which have pages of their own, and what other
    packages describe."""
    module = getattr(thing, "__module__", None)
    if callable(thing) and module and not module.startswith(PUBLIC):
        return True
    if what == "module" and any(thing is public for public in public_things()):
        return True
    return None


@cache
def public_things() -> tuple[Any, ...]:
    """Return the objects behind the public names."""
    return tuple(
        getattr(importlib.import_module(package), name)
        for package in PUBLIC
        for name in names_of(package)
    )


def public_names(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Link a module's page to its public names, which are described elsewhere."""
    for package in PUBLIC if what == "module" and name not in PUBLIC else ():
        there = importlib.import_module(package)
        names = [
            n for n in names_of(package) if getattr(getattr(there, n), "__module__", None) == name
        ]
        if names:
            lines += [
                "",
                f"Public, see :doc:`/api/{package}`: "
                + ", ".join(f":py:obj:`{package}.{n}`" for n in names),
            ]


def plain_words(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Escape text that reStructuredText would read as markup: bars, and text before a colon in a
    property."""
    for i, line in enumerate(lines):
        parts = re.split(r"(``.*?``)", line)  # every other one is a literal
        parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
        lines[i] = "".join(parts)
    if what == "property":
        lines.insert(0, "")


def several_names(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Join attributes that are described together, "low, high", which are else read as a type and a
    name."""
    for i, line in enumerate(lines):
        if names := re.match(r":ivar (\w+(?:, \w+)+):", line):
            lines[i] = f":ivar {names[1].replace(', ', ',')}:{line[names.end() :]}"


def undecorated(app: Sphinx) -> None:
    """Describe what a mocked registry decorates as it is written: the decorator returns a mock."""
    with mock(app.config.autodoc_mock_imports):
        step = importlib.import_module("adaptfault.lerobot.step")
    step.TouchProcessorStep = undecorate(step.TouchProcessorStep)


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    app.connect("builder-inited", undecorated)
    app.connect("source-read", follow_elsewhere)
    app.connect("env-check-consistency", missing_names)
    app.connect("missing-reference", public_name)
    app.connect("autodoc-skip-member", described_elsewhere)
    app.connect("autodoc-process-docstring", plain_words, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", public_names)
    app.connect("autodoc-process-docstring", several_names, priority=900)  # after it
