"""adaptfault explain: what a code of adaptfault check means."""

from __future__ import annotations

from adaptfault.cli.command import Command, argument


class Explain(Command):
    """Explain a code of adaptfault check: what it is, why it matters, its limits."""

    example = """\
  adaptfault explain TOUCH-103
  adaptfault explain
      lists all codes
  adaptfault explain --json adaptfault.check/1
      the JSON Schema of a document"""

    code: str | None = argument(
        "a code, or what it tells, as stuck; the name of a document (default: all codes)",
        "CODE",
        nargs="?",
    )

    def run(self) -> int:
        """Print it."""
        from adaptfault.inspection.code_list import CODES
        from adaptfault.inspection.codes import code_of
        from adaptfault.schemas import SCHEMAS, schema_of

        if self.code is None:
            listed = [f"{code}  {code.name:18s}{code.what}" for code in CODES]
            self.emit({"codes": [code.to_dict() for code in CODES]}, "\n".join(listed))
        elif self.code in SCHEMAS:
            schema = schema_of(self.code)
            self.json = True
            self.emit(schema, "")
        else:
            code = code_of(self.code)
            self.emit(code.to_dict(), code.text())
        return 0


add = Explain.add
