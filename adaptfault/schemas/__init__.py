"""JSON Schemas of documents, by the name that each document states as its ``schema``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

SCHEMAS: Mapping[str, str] = {"adaptfault.check/1": "check.json"}
"""The file of each schema, in this folder."""


def schema_of(document: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a document.

    Args:
        document: what it states as its ``schema``, a key of :data:`SCHEMAS`.
    """
    schema: dict[str, Any] = json.loads(files(__name__).joinpath(SCHEMAS[document]).read_text())
    return schema
