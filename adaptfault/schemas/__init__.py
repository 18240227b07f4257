"""JSON Schemas of documents, by the name that each document states as its ``schema``."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

SCHEMAS: Mapping[str, str] = {
    "adaptfault.check/1": "check.json",
    "adaptfault.diagnosis/1": "diagnosis.json",
    "adaptfault.info/1": "info.json",
    "adaptfault.inspection/1": "inspection.json",
    "adaptfault.layout/1": "layout.json",
    "adaptfault.profile/1": "profile.json",
}
"""The file of each schema, in this folder."""

_USED = re.compile(r'"urn:adaptfault:(\w+):(\d+)["#]')


def schema_of(document: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a document, with those of the documents in it.

    Args:
        document: what it states as its ``schema``, a key of :data:`SCHEMAS`.
    """
    parts: dict[str, dict[str, Any]] = {}
    left = [document]
    while left:
        name = left.pop()
        text = files(__name__).joinpath(SCHEMAS[name]).read_text()
        parts[name] = json.loads(text)
        used = {f"adaptfault.{kind}/{version}" for kind, version in _USED.findall(text)}
        left += sorted(used - parts.keys())
    schema = parts.pop(document)
    return {**schema, "$defs": {**schema.get("$defs", {}), **parts}}
