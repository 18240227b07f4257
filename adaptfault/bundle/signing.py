"""Signs a bundle; needs the extra ``sign`` (cryptography)."""

from __future__ import annotations

import json
from os import PathLike

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.pointer import Pointer
from adaptfault.bundle.signature import NAME, SCHEMA, canonical, read_private_key
from adaptfault.data.atomic import atomic_write


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
    key = read_private_key(private_key)
    path = bundle.path / NAME
    before = json.loads(path.read_bytes())["signed"]["serial"] if path.exists() else 0
    serial = before + 1 if serial is None else serial
    if serial <= before:
        raise ValueError(
            f"serial number {serial}: expected more than {before}, which is signed already"
        )
    pointer = Pointer.read(bundle.path)
    versions = {}
    for number in sorted({1, pointer.active, *pointer.fallbacks}):
        try:
            versions[str(bundle.versions[number].number)] = bundle.versions.hash(number)
        except (FileNotFoundError, Damaged):  # it does not run either
            continue
    signed = {"schema": SCHEMA, "serial": serial, "manifest": bundle.about, "versions": versions}
    document = {"signed": signed, "signature": key.sign(canonical(signed)).hex()}
    atomic_write(path, json.dumps(document, indent=1, allow_nan=False).encode())
