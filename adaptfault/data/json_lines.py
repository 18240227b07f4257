"""An append-only file of JSON lines: the log of a run, from which a killed run continues."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write


class Lines:
    """One JSON document a line.

    Args:
        path: the file; it need not exist. An incomplete last line, which a kill leaves, is dropped.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[Any]:
        """Return the documents, the oldest first.

        Raises:
            ValueError: a whole line is not JSON; it names the file and the line.
        """
        if not self.path.exists():
            return []
        whole, _, part = self.path.read_bytes().rpartition(b"\n")
        if part:
            atomic_write(self.path, whole + b"\n" if whole else b"")
        documents = []
        for number, line in enumerate(whole.splitlines(), 1):
            try:
                documents.append(json.loads(line))
            except (ValueError, RecursionError) as error:
                raise ValueError(
                    f"{self.path}, line {number}: not JSON ({error}); remove the file"
                ) from None
        return documents

    def add(self, document: Any) -> None:
        """Append a document."""
        with self.path.open("a") as file:
            file.write(json.dumps(document, allow_nan=False) + "\n")

    def begin(self, document: Any) -> None:
        """Replace the content with this document."""
        atomic_write(self.path, (json.dumps(document, allow_nan=False) + "\n").encode())
