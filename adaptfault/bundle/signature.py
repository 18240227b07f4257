"""Signed bundles: an ed25519 signature over the manifest and the versions. Needs the extra ``sign``
(cryptography)."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.versions import Untrusted, Versions
from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings.facts.sizes import check_file

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import (
        Ed25519PrivateKey,
        Ed25519PublicKey,
    )

SCHEMA = "adaptfault.signature/1"
NAME = "signature.json"

_MISSING = "signatures need cryptography; pip install 'adaptfault[sign]'"


def verify(
    folder: Path, manifest: dict[str, Any], keys: Sequence[str | PathLike[str]], least_serial: int
) -> tuple[int, dict[int, str]]:
    """Return the serial number of the signature, and number and hash of each version that a
    trusted key signed.

    Args:
        folder: of the bundle.
        manifest: that was read from it.
        keys: PEM files of the trusted keys:
            ``openssl pkey -in private.pem -pubout -out public.pem``. A private key stands for its
            public one.
        least_serial: smallest serial number that is accepted.

    Raises:
        Untrusted: the bundle is not signed, not by one of these keys, was changed since, or is
            older than that.
        ValueError: a file holds no ed25519 key, or cryptography is not installed.
    """
    path = folder / NAME
    trusted = [_read_public_key(key) for key in keys]
    try:
        check_file(path)
        document = json.loads(path.read_bytes())
        signed = document["signed"]
        signature = bytes.fromhex(document["signature"])
        data = canonical(signed)
    except FileNotFoundError:
        raise Untrusted(
            f"{folder} is not signed; adaptfault train --sign or adaptfault.sign_bundle signs it"
        ) from None
    except (ValueError, TypeError, KeyError, RecursionError):
        raise Untrusted(f"{path} holds no signature; sign the bundle again") from None
    if not any(_verifies(key, signature, data) for key in trusted):
        raise Untrusted(f"{folder} is not signed by one of the {len(keys)} trusted keys")
    if signed["schema"] != SCHEMA:
        raise Untrusted(f"{path} has schema {signed['schema']!r}, expected {SCHEMA!r}")
    if signed["manifest"] != manifest:
        raise Untrusted(
            f"{folder}: the manifest is not the signed one, from another bundle or changed"
        )
    if signed["serial"] < least_serial:
        raise Untrusted(
            f"{folder} has serial number {signed['serial']}, expected {least_serial} or more"
        )
    versions = {int(number): str(digest) for number, digest in signed["versions"].items()}
    return int(signed["serial"]), versions


def _key_in(path: str | PathLike[str]) -> Any:
    """Return the key in a PEM file, private or public; None: there is none without a password."""
    check_file(Path(path))
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives import serialization
    except ImportError:
        raise ValueError(_MISSING) from None
    data = Path(path).read_bytes()
    try:
        if b"PRIVATE KEY" in data:
            return serialization.load_pem_private_key(data, password=None)
        return serialization.load_pem_public_key(data)
    except (ValueError, TypeError, UnsupportedAlgorithm):  # TypeError: it has a password
        return None


def read_private_key(path: str | PathLike[str]) -> Ed25519PrivateKey:
    """Return the ed25519 key in a PEM file; raises ValueError, also where cryptography is not
    installed."""
    key = _key_in(path)
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError(
            f"{path}: expected an ed25519 key without password; openssl genpkey -algorithm ed25519"
        )
    return key


def _read_public_key(path: str | PathLike[str]) -> Ed25519PublicKey:
    key = _key_in(path)
    from cryptography.hazmat.primitives.asymmetric.ed25519 import (
        Ed25519PrivateKey,
        Ed25519PublicKey,
    )

    if isinstance(key, Ed25519PrivateKey):
        return key.public_key()
    if not isinstance(key, Ed25519PublicKey):
        raise ValueError(
            f"{path}: expected the public part of an ed25519 key; openssl pkey -in KEY -pubout"
        )
    return key


def _verifies(key: Ed25519PublicKey, signature: bytes, data: bytes) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        key.verify(signature, data)
    except InvalidSignature:
        return False
    return True


def canonical(signed: dict[str, Any]) -> bytes:
    """Return the bytes that are signed."""
    return json.dumps(signed, sort_keys=True, allow_nan=False).encode()


def sign_versions(
    folder: Path,
    manifest: dict[str, Any],
    versions: Versions,
    private_key: str | PathLike[str],
    numbers: Collection[int],
    *,
    before: int,
    serial: int | None,
) -> int:
    """Sign the manifest of a bundle and the versions of these numbers; return the serial number.

    Args:
        folder: of the bundle.
        manifest, versions: that it holds; a version that cannot be read, or may not run, is left
            out.
        private_key: PEM file of an ed25519 key.
        numbers: of the versions.
        before: serial number that is known to be signed already.
        serial: of this signature; None: the next one.

    Raises:
        ValueError: the key is none, or the serial number is not larger than all before.
        Damaged: the file of the signature holds none.
    """
    key = read_private_key(private_key)
    path = folder / NAME
    before = max(before, _serial(path))
    serial = before + 1 if serial is None else serial
    if serial <= before:
        raise ValueError(
            f"serial number {serial}: expected more than {before}, which is signed already"
        )
    digests = {}
    for number in sorted(numbers):
        try:
            digests[str(number)] = versions[number].digest
        except (FileNotFoundError, Damaged):  # it does not run either
            continue
    signed = {"schema": SCHEMA, "serial": serial, "manifest": manifest, "versions": digests}
    document = {"signed": signed, "signature": key.sign(canonical(signed)).hex()}
    atomic_write(path, json.dumps(document, indent=1, allow_nan=False).encode())
    return serial


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
