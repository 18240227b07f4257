"""Signed bundles: an ed25519 signature over the manifest and the versions. Needs the extra ``sign`` (cryptography)."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.data.atomic import atomic_write
from adaptfault.robot.checksummed_json import hash_file
from adaptfault.robot.versions import ABOUT

if TYPE_CHECKING:
    from adaptfault.robot.bundle import Bundle

SCHEMA = "adaptfault.signature/1"
NAME = "signature.json"


class Untrusted(ValueError):
    """A bundle or a version that no trusted key signed."""


def sign_bundle(bundle: Bundle, private_key: str | PathLike[str], *, serial: int) -> None:
    """Sign the manifest of a bundle and all its versions.

    The manifest holds the hash of every part, and the description of a version that of each of its files.

    Args:
        bundle: to sign; sign it again after a maintenance run that deployed a version.
        private_key: PEM file of an ed25519 key: ``openssl genpkey -algorithm ed25519 -out private.pem``.
        serial: number of this state of the bundle, larger than all before; a robot refuses smaller ones.

    Raises:
        ValueError: the key is no ed25519 key, or the serial number is not larger than the one that is signed.
    """
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    key = load_pem_private_key(Path(private_key).read_bytes(), password=None)
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError(f"{private_key}: expected an ed25519 key; openssl genpkey -algorithm ed25519")
    path = bundle.path / NAME
    before = json.loads(path.read_bytes())["signed"]["serial"] if path.exists() else 0
    if serial <= before:
        raise ValueError(f"serial number {serial}: expected more than {before}, which is signed already")
    signed = {
        "schema": SCHEMA,
        "serial": serial,
        "manifest": bundle.about,
        "versions": {str(number): _hash(bundle, number) for number in bundle.versions.numbers},
    }
    document = {"signed": signed, "signature": key.sign(_canonical(signed)).hex()}
    atomic_write(path, json.dumps(document, indent=1, allow_nan=False).encode())


def verify_bundle(bundle: Bundle, public_keys: Sequence[str | PathLike[str]], least_serial: int) -> Collection[int]:
    """Return the numbers of the versions that a trusted key signed.

    Args:
        bundle: to verify.
        public_keys: PEM files of the trusted keys: ``openssl pkey -in private.pem -pubout -out public.pem``.
        least_serial: smallest serial number that is accepted.

    Raises:
        Untrusted: the bundle is not signed, not by one of these keys, was changed since, or is older than that.
    """
    path = bundle.path / NAME
    try:
        document = json.loads(path.read_bytes())
        signed, signature = document["signed"], bytes.fromhex(document["signature"])
        data = _canonical(signed)
    except FileNotFoundError:
        raise Untrusted(f"{bundle.path} is not signed; adaptfault.sign_bundle signs it") from None
    except (ValueError, TypeError, KeyError):
        raise Untrusted(f"{path} holds no signature; sign the bundle again") from None
    if not any(_verifies(key, signature, data) for key in public_keys):
        raise Untrusted(f"{bundle.path} is not signed by one of the {len(public_keys)} trusted keys")
    if signed["schema"] != SCHEMA:
        raise Untrusted(f"{path} has schema {signed['schema']!r}, expected {SCHEMA!r}")
    if signed["manifest"] != bundle.about:
        raise Untrusted(f"{bundle.path}: the manifest is not the signed one, from another bundle or changed")
    if signed["serial"] < least_serial:
        raise Untrusted(f"{bundle.path} has serial number {signed['serial']}, expected {least_serial} or more")
    here = {n for n in bundle.versions.numbers if (bundle.versions.path(n) / ABOUT).is_file()}
    return {n for n in here if signed["versions"].get(str(n)) == _hash(bundle, n)}


def _verifies(public_key: str | PathLike[str], signature: bytes, data: bytes) -> bool:
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    key = load_pem_public_key(Path(public_key).read_bytes())
    if not isinstance(key, Ed25519PublicKey):
        raise ValueError(f"{public_key}: expected the public part of an ed25519 key")
    try:
        key.verify(signature, data)
    except InvalidSignature:
        return False
    return True


def _hash(bundle: Bundle, number: int) -> str:
    return hash_file(bundle.versions.path(number) / ABOUT)


def _canonical(signed: dict[str, Any]) -> bytes:
    return json.dumps(signed, sort_keys=True, allow_nan=False).encode()
