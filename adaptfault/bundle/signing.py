"""Signs a bundle; needs the extra ``sign`` (cryptography)."""

from __future__ import annotations

import json
from collections.abc import Collection
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.pointer import Pointer
from adaptfault.bundle.signature import NAME, SCHEMA, canonical, read_private_key
from adaptfault.data.atomic import atomic_write

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle


def sign_bundle(
    bundle: Bundle, private_key: str | PathLike[str], *, serial: int | None = None
) -> None:
    """Sign the manifest of a bundle and the versions that may run: the active one, its fallbacks,
    and the fault-free.

    The manifest holds the hash of every part, and the description of a version that of each of its
    files.

    Args:
        bundle: to sign; sign it again after a maintenance run that deployed a version. Opened with
            ``keys``, only versions are signed that were signed before or written by this object;
            otherwise, what is on the disk.
        private_key: PEM file of an ed25519 key:
            ``openssl genpkey -algorithm ed25519 -out private.pem``.
        serial: number of this state of the bundle, larger than all before; a robot refuses smaller
            ones. None: one more than the number that is signed.

    Raises:
        ValueError: the key is no ed25519 key, cryptography is not installed, or the serial number
            is not larger than the one that is signed.
        Damaged: the pointer to the active version cannot be read.
    """
    numbers = Pointer.read(bundle.path).versions
    sign_versions(bundle, private_key, numbers, serial=serial)


def sign_versions(
    bundle: Bundle,
    private_key: str | PathLike[str],
    numbers: Collection[int],
    *,
    serial: int | None = None,
) -> None:
    """Sign the manifest of a bundle and the versions of these numbers; see
    :func:`sign_bundle`."""
    key = read_private_key(private_key)
    path = bundle.path / NAME
    before = max(bundle.serial, _serial(path))
    serial = before + 1 if serial is None else serial
    if serial <= before:
        raise ValueError(
            f"serial number {serial}: expected more than {before}, which is signed already"
        )
    versions = {}
    for number in sorted(numbers):
        try:
            version = bundle.versions[number]
            versions[str(version.number)] = version.digest
        except (FileNotFoundError, Damaged):  # it does not run either
            continue
    signed = {"schema": SCHEMA, "serial": serial, "manifest": bundle.about, "versions": versions}
    document = {"signed": signed, "signature": key.sign(canonical(signed)).hex()}
    atomic_write(path, json.dumps(document, indent=1, allow_nan=False).encode())
    bundle.serial = serial


def _serial(path: Path) -> int:
    """Return the serial number in a file of a signature; 0 where there is none.

    Raises:
        Damaged: the file holds no signature.
    """
    try:
        return int(json.loads(path.read_bytes())["signed"]["serial"])
    except FileNotFoundError:
        return 0
    except (ValueError, TypeError, KeyError, RecursionError):
        raise Damaged(f"{path} holds no signature; remove it, and sign the bundle again") from None
