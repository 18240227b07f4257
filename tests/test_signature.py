"""Signed bundles: the attacks on updates, as TUF names them, one by one."""

import json
import shutil

import pytest

from adaptfault.robot.bundle import Bundle
from adaptfault.robot.checksummed_json import Damaged, write_with_copy
from adaptfault.robot.predictor import Predictor
from adaptfault.robot.signature import NAME, Untrusted, sign_bundle
from diagnostics import FaultSet

pytest.importorskip("cryptography")


def write_keys(folder, name):
    """Write a pair of keys; return the paths of the private and the public one."""
    from cryptography.hazmat.primitives import serialization as to
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = Ed25519PrivateKey.generate()
    private, public = folder / f"{name}.pem", folder / f"{name}.pub.pem"
    private.write_bytes(key.private_bytes(to.Encoding.PEM, to.PrivateFormat.PKCS8, to.NoEncryption()))
    public.write_bytes(key.public_key().public_bytes(to.Encoding.PEM, to.PublicFormat.SubjectPublicKeyInfo))
    return private, public


@pytest.fixture
def bundle(linear_bundle, tmp_path):
    """A copy of it, to be changed."""
    shutil.copytree(linear_bundle, tmp_path / "robot.bundle")
    return Bundle.open(tmp_path / "robot.bundle")


@pytest.fixture
def keys(tmp_path):
    return write_keys(tmp_path, "factory")


def deploy(bundle: Bundle, *cells: int) -> int:
    adaptation = bundle.parts.adapter().adapt(FaultSet(cells, bundle.layout.n_cells), method="fill")
    number = bundle.write_version(adaptation, {}).number
    bundle.deploy(number)
    return number


def test_a_signed_bundle_opens_with_the_public_key_and_without(bundle, keys):
    sign_bundle(bundle, keys[0], serial=1)
    assert Bundle.open(bundle.path, keys=[keys[1]]).active().number == 1
    assert Predictor.load(bundle.path, keys=[keys[1]], least_serial=1).version == 1
    assert Bundle.open(bundle.path).active().number == 1


def test_an_unsigned_bundle_is_refused(bundle, keys):
    with pytest.raises(Untrusted, match="is not signed"):
        Bundle.open(bundle.path, keys=[keys[1]])
    (bundle.path / NAME).write_text("{}")
    with pytest.raises(Untrusted, match="holds no signature"):
        Bundle.open(bundle.path, keys=[keys[1]])


def test_arbitrary_software_signed_with_another_key_is_refused(bundle, keys, tmp_path):
    private, public = write_keys(tmp_path, "attacker")
    sign_bundle(bundle, private, serial=1)
    with pytest.raises(Untrusted, match="not signed by one of the 1 trusted keys"):
        Bundle.open(bundle.path, keys=[keys[1]])
    assert Bundle.open(bundle.path, keys=[keys[1], public]).active().number == 1


def test_a_rollback_to_an_older_signed_bundle_is_refused(bundle, keys, tmp_path):
    sign_bundle(bundle, keys[0], serial=4)
    shutil.copytree(bundle.path, tmp_path / "old")
    sign_bundle(bundle, keys[0], serial=5)
    assert Bundle.open(bundle.path, keys=[keys[1]], least_serial=5)
    with pytest.raises(Untrusted, match="serial number 4, expected 5 or more"):
        Bundle.open(tmp_path / "old", keys=[keys[1]], least_serial=5)
    with pytest.raises(ValueError, match="expected more than 5"):
        sign_bundle(bundle, keys[0], serial=5)


def test_a_serial_number_that_was_raised_by_hand_is_refused(bundle, keys):
    sign_bundle(bundle, keys[0], serial=1)
    document = json.loads((bundle.path / NAME).read_text())
    document["signed"]["serial"] = 9
    (bundle.path / NAME).write_text(json.dumps(document))
    with pytest.raises(Untrusted, match="not signed by"):
        Bundle.open(bundle.path, keys=[keys[1]], least_serial=9)


def test_mix_and_match_the_signature_of_another_bundle_is_refused(bundle, keys, tmp_path):
    shutil.copytree(bundle.path, tmp_path / "other")
    write_with_copy(tmp_path / "other" / "bundle.json", {**bundle.about, "created": "another day"})
    sign_bundle(Bundle.open(tmp_path / "other"), keys[0], serial=1)
    shutil.copy(tmp_path / "other" / NAME, bundle.path / NAME)
    with pytest.raises(Untrusted, match="the manifest is not the signed one"):
        Bundle.open(bundle.path, keys=[keys[1]])


def test_mix_and_match_a_version_of_another_signed_bundle_does_not_run(bundle, keys, tmp_path):
    shutil.copytree(bundle.path, tmp_path / "other")
    other = Bundle.open(tmp_path / "other")
    deploy(other, 3)
    deploy(bundle, 7)
    for one in (bundle, other):
        sign_bundle(one, keys[0], serial=1)
    assert Bundle.open(bundle.path, keys=[keys[1]]).active().number == 2
    shutil.rmtree(bundle.path / "versions" / "0002")
    shutil.copytree(other.versions.path(2), bundle.versions.path(2))
    assert Bundle.open(bundle.path, keys=[keys[1]]).active().number == 1


def test_a_version_that_nobody_signed_does_not_run(bundle, keys):
    sign_bundle(bundle, keys[0], serial=1)
    deploy(bundle, 3)
    assert Bundle.open(bundle.path, keys=[keys[1]]).active().number == 1
    assert Bundle.open(bundle.path).active().number == 2
    sign_bundle(bundle, keys[0], serial=2)
    assert Bundle.open(bundle.path, keys=[keys[1]]).active().number == 2


def test_changed_content_with_its_old_signature_is_refused(bundle, keys):
    sign_bundle(bundle, keys[0], serial=1)
    weights = next(bundle.versions.path(1).glob("weights-*"))
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(bytes(data))
    with pytest.raises(Damaged):
        Bundle.open(bundle.path, keys=[keys[1]]).active()
    check = next((bundle.path / "parts" / "check").glob("weights-*"))
    check.write_bytes(check.read_bytes()[:-1])
    with pytest.raises(Damaged):
        Bundle.open(bundle.path, keys=[keys[1]]).parts.check_windows()
