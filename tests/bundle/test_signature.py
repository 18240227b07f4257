"""Signed bundles: the attacks on updates, as TUF names them, one by one."""

import json
import shutil

import numpy as np
import pytest
from conftest import write_keys

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import Damaged, write_with_copy
from adaptfault.bundle.signature import NAME
from adaptfault.bundle.signing import sign_bundle
from adaptfault.bundle.versions import Untrusted
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.fleet.listing import Fleet, Robot
from adaptfault.fleet.run import maintain_fleet
from adaptfault.fleet.work import maintain_robot
from adaptfault.prediction.predictor import Predictor
from diagnostics import FaultSet

pytest.importorskip("cryptography")


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


def test_a_version_that_was_rolled_back_is_not_signed_again(bundle, keys):
    deploy(bundle, 3)
    sign_bundle(bundle, keys[0], serial=1)
    bundle.rollback()
    sign_bundle(bundle, keys[0])
    assert bundle.versions[2].number == 2
    bundle.deploy(2)  # what an attacker can write who has no key: the pointer
    trusted = Bundle.open(bundle.path, keys=[keys[1]], least_serial=2)
    assert trusted.active().number == 1
    with pytest.raises(Untrusted, match="version 2 is not signed"):
        trusted.versions[2]


def test_signing_again_leaves_out_what_another_program_put_there(bundle, keys):
    sign_bundle(bundle, keys[0])
    trusted = Bundle.open(bundle.path, keys=[keys[1]])
    deploy(bundle, 3)  # by a program without the key
    deploy(trusted, 7)
    assert trusted.active().number == 3
    sign_bundle(trusted, keys[0])
    again = Bundle.open(bundle.path, keys=[keys[0]])
    assert again.active().fault_set == {7}
    assert set(again.versions.signed) == {1, 3}


def test_a_version_that_is_exchanged_while_the_bundle_is_open_does_not_run(bundle, keys, tmp_path):
    deploy(bundle, 3)
    shutil.copytree(bundle.path, tmp_path / "other")
    other = Bundle.open(tmp_path / "other")
    shutil.rmtree(other.versions.path(2))
    deploy(other, 7)
    sign_bundle(bundle, keys[0])
    trusted = Bundle.open(bundle.path, keys=[keys[1]])
    shutil.rmtree(bundle.versions.path(2))
    shutil.copytree(other.versions.path(2), bundle.versions.path(2))
    assert trusted.active().number == 1


def test_files_that_hold_no_ed25519_key_are_named(bundle, keys, tmp_path):
    wrong = tmp_path / "wrong.pem"
    wrong.write_text("no key")
    with pytest.raises(ValueError, match=r"wrong.pem: expected an ed25519 key"):
        sign_bundle(bundle, wrong)
    sign_bundle(bundle, keys[0])
    with pytest.raises(ValueError, match=r"wrong.pem: expected the public part"):
        Bundle.open(bundle.path, keys=[wrong])


def run(capsys, *words) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command."""
    code = main([*map(str, words), "--quiet"])
    told = capsys.readouterr()
    return code, told.out, told.err


OPENING = {
    "maintain": "maintain BUNDLE LOG --dry-run",
    "rollback": "rollback BUNDLE",
    "history": "history BUNDLE",
    "report": "report BUNDLE --out PAGE",
    "listen": "listen BUNDLE --port 0 --frames 1",
    "diagnose": "diagnose LOG --reference BUNDLE",
    "restore": "restore LOG --bundle BUNDLE --out FOLDER",
    "predict": "predict LOG --bundle BUNDLE",
    "evaluate": "evaluate BUNDLE LOG",
    "adapt": "adapt BUNDLE --faults 3 --forecast",
    "forecast": "forecast BUNDLE --faults 3",
}


@pytest.mark.parametrize("name", OPENING)
def test_every_command_that_opens_a_bundle_verifies_it(bundle, keys, tmp_path, capsys, name):
    np.save(tmp_path / "log.npy", np.zeros((20, bundle.layout.n_cells)))
    paths = {
        "BUNDLE": bundle.path,
        "LOG": tmp_path / "log.npy",
        "PAGE": tmp_path / "a.html",
        "FOLDER": tmp_path / "out",
    }
    words = [paths.get(word, word) for word in OPENING[name].split()]
    code, _, told = run(capsys, *words, "--trust", keys[1])
    assert (code, told.count("\n")) == (3, 1)
    assert "is not signed; adaptfault train --sign" in told
    sign_bundle(bundle, keys[0], serial=4)
    code, _, told = run(capsys, *words, "--trust", keys[1], "--least-serial", "5")
    assert code == 3
    assert "serial number 4, expected 5 or more" in told


def test_train_signs_a_bundle_and_history_says_what_is_not_signed(keys, tmp_path, capsys):
    import power_cut

    grasps = simulate(6, power_cut.LAYOUT, n_frames=20, seed=1, classes=power_cut.CLASSES)
    save_npz(tmp_path / "grasps.npz", grasps)
    out = tmp_path / "robot.bundle"
    with power_cut.small_versions():
        words = [
            "train",
            tmp_path / "grasps.npz",
            "--epochs",
            1,
            "--model",
            "power_cut:linear",
            "--sign",
            keys[0],
        ]
        code, _, told = run(capsys, *words, "--out", tmp_path / "model")
        assert (code, "--sign signs bundles" in told) == (3, True)
        assert run(capsys, *words, "--out", out)[0] == 0
        assert (
            "damage" not in run(capsys, "history", out, "--trust", keys[1], "--least-serial", 1)[1]
        )
        code, _, told = run(capsys, "history", out, "--least-serial", 1)
        assert (code, "--least-serial needs --trust" in told) == (3, True)
        deploy(Bundle.open(out), 3)
        text = run(capsys, "history", out, "--trust", keys[1])[1]
    assert text.startswith("version 1")
    assert "damage: version 2 is not signed" in text


def test_maintain_signs_what_it_deploys_and_warns_where_it_does_not(bundle, keys, tmp_path, capsys):
    import power_cut

    sign_bundle(bundle, keys[0])
    save_npz(tmp_path / "log.npz", Recordings(tuple(power_cut.broken_log()), bundle.layout))
    shutil.copytree(bundle.path, tmp_path / "other")
    words = [tmp_path / "log.npz", "--trust", keys[1]]
    assert "version 2 is not signed" in run(capsys, "maintain", tmp_path / "other", *words)[2]
    assert "warning" not in run(capsys, "maintain", bundle.path, *words, "--sign", keys[0])[2]
    assert Bundle.open(bundle.path, keys=[keys[1]], least_serial=2).active().number == 2
    with pytest.raises(Untrusted, match="version 2 is not signed"):
        Bundle.open(tmp_path / "other", keys=[keys[1]]).versions[2]
    run(capsys, "maintain", bundle.path, *words, "--sign", keys[0], "--dry-run")
    assert json.loads((bundle.path / NAME).read_text())["signed"]["serial"] == 2


def test_a_fleet_signs_each_bundle_after_its_run(bundle, keys, tmp_path):
    log = tmp_path / "log.npy"
    np.save(log, np.zeros((20, bundle.layout.n_cells)))
    robot = Robot("r1", str(bundle.path), (str(log),))
    options = {"keys": [str(keys[1])], "sign": str(keys[0])}
    assert "is not signed" in maintain_robot(robot, **options).reason
    sign_bundle(bundle, keys[0])
    assert maintain_robot(robot, **options).decision != "error"
    assert Bundle.open(bundle.path, keys=[keys[1]], least_serial=2)
    with pytest.raises(ValueError, match="sign needs keys"):
        maintain_fleet(Fleet((robot,)), tmp_path / "run", sign=str(keys[0]))
