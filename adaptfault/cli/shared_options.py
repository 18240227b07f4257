"""Options that several commands have, beside those of :mod:`adaptfault.cli.reading`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from adaptfault.cli.command import Command, argument, option
from adaptfault.cli.paths import Read, Stated, Written

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle


class Trusting(Command):
    """Whose signature a bundle needs."""

    trust_section = "signed bundles"

    trust: list[Read] | None = option(
        "PEM file of a public ed25519 key that must have signed the bundle; may be repeated",
        "KEY",
        action="append",
        section="trust_section",
    )
    least_serial: int | None = option(
        "with --trust: smallest serial number of the signature", "N", section="trust_section"
    )

    @property
    def keys(self) -> list[Read]:
        """The keys that are trusted."""
        return list(self.trust or [])

    def trusted(self) -> dict[str, Any]:
        """Return whose signature a bundle needs, as ``Bundle.open`` takes it.

        Raises:
            ValueError: a serial number without a key.
        """
        if self.least_serial is not None and not self.trust:
            raise ValueError("--least-serial needs --trust KEY")
        return {"keys": self.keys or None, "least_serial": self.least_serial or 0}

    def opened(self, folder: str) -> Bundle:
        """Return the bundle in a folder.

        Raises:
            FileNotFoundError, ValueError: there is none, damaged, or not signed by a trusted key.
        """
        from adaptfault.bundle.bundle import Bundle

        return Bundle.open(folder, **self.trusted())


def sign_option(when: str, **how: Any) -> Any:
    """Return the key that signs a bundle."""
    return option(f"sign {when} with this private ed25519 key (PEM)", "KEY", **how)


class Signing(Trusting):
    """The key that signs a bundle, and is trusted, too."""

    sign: Read | None = sign_option("the bundle after the run")

    @property
    def keys(self) -> list[Read]:
        """The keys that are trusted."""
        return super().keys if self.sign is None else [*super().keys, self.sign]


def bundle_argument() -> Any:
    """Return the bundle of a robot."""
    return argument("folder written by adaptfault train --out X.bundle", "BUNDLE")


def faults_option() -> Any:
    """Return F."""
    return option("a diagnosis (JSON), or cell indices as 3,17,200", "F", type=Stated)


def reference_option() -> Any:
    """Return what a log is compared with."""
    return option("fault-free recordings of the same array, or a bundle", "FILE")


def cache_option() -> Any:
    """Return the option that keeps no fit."""
    return option("fit anew, and keep nothing beside the reference (.adaptfault/)")


def untested_code_option() -> Any:
    """Return the exit code of a log that tests nothing."""
    return option(
        "exit code where no fault is found and less than 5 %% of the cells are tested (default 1)",
        "CODE",
        default=1,
        choices=range(4),
    )


def count_from_option() -> Any:
    """Return the number of the first pad, row and column."""
    return option(
        "number of the first pad, row, column and cell in text, pages and pictures, 0 or 1"
        " (default 0; JSON counts from 0)",
        "N",
        default=0,
        choices=(0, 1),
    )


def lines_held_option() -> Any:
    """Return whether a scan holds lines (:class:`diagnostics.Scan`)."""
    return option(
        "the read-out holds the lines that it does not select: crossings that answer a scan are"
        " alive, however alike they conduct"
    )


def metrics_option() -> Any:
    """Return the file of metrics."""
    return option(
        "write metrics for Prometheus, as node_exporter's textfile collector reads them",
        "FILE.prom",
        type=_metrics_file,
    )


def _metrics_file(text: str) -> Written:
    if not text.endswith(".prom"):
        what = "expected a name that ends in .prom: node_exporter reads no other"
        raise argparse.ArgumentTypeError(f"{what}; got {text!r}")
    return Written(text)


def device_option() -> Any:
    """Return the device that trains networks."""
    return option("auto, cpu or cuda (default auto: cuda where there is one)", default="auto")


def chosen_device(name: str) -> str:
    """Return the device that networks are trained on.

    Raises:
        ValueError: there is no such device.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(
            f"--device {name}: {str(error).splitlines()[0]}; use auto, cpu or cuda"
        ) from None
    return name
