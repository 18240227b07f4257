"""Signs a bundle; needs the extra ``sign`` (cryptography)."""

from __future__ import annotations

from os import PathLike

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.pointer import Pointer


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
    bundle.sign(private_key, Pointer.read(bundle.path).versions, serial=serial)
