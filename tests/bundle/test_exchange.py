"""Files that are exchanged while a signed bundle is used: what was checked is what is used."""

import builtins
import io
import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import power_cut
import pytest
from conftest import write_keys

from adaptfault.adaptation.adapter_files import save_adapter
from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import Damaged, write_checksummed, write_with_copy
from adaptfault.bundle.parts import Parts
from adaptfault.bundle.signing import sign_bundle
from adaptfault.bundle.versions import Version
from adaptfault.cli import main
from adaptfault.data.calibration import Calibration
from adaptfault.data.recordings import save_npz
from adaptfault.data.simulated_grasps import simulate
from adaptfault.prediction.predictor import Predictor
from adaptfault.robot.maintenance import maintain
from diagnostics import FaultSet

pytest.importorskip("cryptography")

EVERY = range(power_cut.LAYOUT.n_cells)


@pytest.fixture
def keys(tmp_path):
    return write_keys(tmp_path, "factory")


@pytest.fixture
def signed(linear_bundle, tmp_path, keys):
    """The folder of a signed bundle, to be changed."""
    shutil.copytree(linear_bundle, tmp_path / "robot.bundle")
    sign_bundle(Bundle.open(tmp_path / "robot.bundle"), keys[0])
    return tmp_path / "robot.bundle"


@pytest.fixture
def attacker(signed, tmp_path):
    """A folder like it, whole in itself, with another version 1 and labels that are exchanged."""
    place = Path(shutil.copytree(signed, tmp_path / "attacker"))
    bundle = Bundle.open(place)
    adapter = bundle.parts.adapter()
    dropped = FaultSet(tuple(EVERY)[: len(EVERY) // 2], len(EVERY))
    other = bundle.write_version(adapter.adapt(dropped, method="fill", progress=False), {})
    document = json.loads((other.folder / "version.json").read_text())
    del document["sha256"]
    shutil.rmtree(place / "versions" / "0001")
    write_checksummed(other.folder / "version.json", {**document, "number": 1})
    other.folder.rename(place / "versions" / "0001")
    for windows in (adapter.train, adapter.validation):
        windows.y[:] = 1 - windows.y
    save_adapter(place / "parts" / "adapter", adapter)
    hashes = {
        path.relative_to(place / "parts").as_posix(): _hash(path)
        for path in (place / "parts").rglob("*")
        if path.is_file()
    }
    write_with_copy(place / "bundle.json", {**bundle.about, "parts": hashes})
    return place


def _hash(path: Path) -> str:
    from adaptfault.bundle.checksummed_json import hash_file

    return hash_file(path)


def exchange(place: Path, attacker: Path, name: str) -> None:
    """Exchange a folder of a bundle with that of the attacker."""
    shutil.rmtree(place / name)
    shutil.copytree(attacker / name, place / name)


@contextmanager
def exchanged_before_read(place: Path, attacker: Path, number: int):
    """Exchange parts and versions before the read of this number; yield the number of reads."""
    real = open
    reads = [0]

    def opened(path, mode="r", *args, **options):
        if not isinstance(path, int) and "r" in mode and place in Path(path).parents:
            reads[0] += 1
            if reads[0] == number:
                with pytest.MonkeyPatch.context() as whole:
                    whole.setattr(builtins, "open", real)
                    whole.setattr(io, "open", real)
                    exchange(place, attacker, "parts")
                    exchange(place, attacker, "versions")
        return real(path, mode, *args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(builtins, "open", opened)
        patch.setattr(io, "open", opened)
        yield reads


def test_no_exchange_at_any_read_makes_an_unsigned_version_run(signed, attacker, keys, tmp_path):
    window = np.random.default_rng(0).uniform(0, 1, (3, 10, len(EVERY))).astype(np.float32)
    right = Predictor.load(signed, keys=[keys[1]]).predict_proba(window)
    assert (right != Predictor.load(attacker).predict_proba(window)).any()
    copy = tmp_path / "copy.bundle"
    number = outcomes = 0
    while True:
        number += 1
        shutil.copytree(signed, copy)
        with exchanged_before_read(copy, attacker, number) as reads:
            try:
                assert (Predictor.load(copy, keys=[keys[1]]).predict_proba(window) == right).all()
                outcomes += 1
            except (Damaged, FileNotFoundError):
                pass
        shutil.rmtree(copy)
        if reads[0] < number:
            break
    assert number > 10
    assert outcomes >= 1  # after the last read


@pytest.mark.parametrize("part", ["adapter", "check", "reference"])
def test_parts_that_are_exchanged_after_their_check_are_neither_used_nor_signed(
    signed, attacker, keys, monkeypatch, part
):
    checked = Parts.check

    def check(self, **options):
        checked(self, **options)
        if part == "adapter":
            exchange(signed, attacker, "parts/adapter")
        else:
            for name in (part, f"{part}.copy"):
                shutil.rmtree(signed / "parts" / name, ignore_errors=True)
                shutil.copytree(attacker / "parts" / "adapter", signed / "parts" / name)

    monkeypatch.setattr(Parts, "check", check)
    with pytest.raises(Damaged), power_cut.small_versions():
        maintain(Bundle.open(signed, keys=[keys[1]]), power_cut.broken_log(), sign=keys[0])
    assert Bundle.open(signed, keys=[keys[1]]).active().number == 1
    assert not (signed / "versions" / "0002").exists()


def test_a_version_that_is_exchanged_after_its_check_does_not_run(
    signed, attacker, keys, monkeypatch
):
    read = Version.read.__func__

    def then_exchanged(cls, folder):
        version = read(cls, folder)
        exchange(signed, attacker, "versions")
        return version

    monkeypatch.setattr(Version, "read", classmethod(then_exchanged))
    with pytest.raises(Damaged, match="no version that can be read"):
        Predictor.load(signed, keys=[keys[1]])


def test_what_is_exchanged_while_it_is_signed_is_not_signed(signed, attacker, keys, monkeypatch):
    bundle = Bundle.open(signed, keys=[keys[1]])
    read = Version.read.__func__

    def then_exchanged(cls, folder):
        version = read(cls, folder)
        exchange(signed, attacker, "versions")
        return version

    monkeypatch.setattr(Version, "read", classmethod(then_exchanged))
    sign_bundle(bundle, keys[0])
    monkeypatch.undo()
    with pytest.raises(Damaged):
        Bundle.open(signed, keys=[keys[1]]).active()


def test_what_the_disk_holds_of_a_new_version_is_not_what_is_signed(
    signed, attacker, keys, monkeypatch
):
    """Somebody writes into the folder of a version that is being made."""
    replace = os.replace

    def replaced(source, target):
        replace(source, target)
        path = Path(target)
        if path.name == "manifest.json" and ".unfinished-" in str(path):
            path.write_bytes((attacker / "versions" / "0001" / "manifest.json").read_bytes())

    monkeypatch.setattr(os, "replace", replaced)
    bundle = Bundle.open(signed, keys=[keys[1]])
    adapter = bundle.parts.adapter()
    with pytest.raises(Damaged), power_cut.small_versions():
        bundle.write_version(adapter.adapt(FaultSet((3,), len(EVERY)), method="fill"), {})


def test_a_part_that_is_not_in_the_manifest_is_not_there(signed, keys):
    assert Bundle.open(signed, keys=[keys[1]]).parts.graph is None
    raw = np.tile([0.0, 100.0], (len(EVERY), 1))
    Calibration(raw, raw / 10).write(signed / "parts" / "calibration.csv")
    (signed / "parts" / "graph.onnx").write_bytes(b"of somebody")
    for options in ({"keys": [keys[1]]}, {}):
        parts = Bundle.open(signed, **options).parts
        assert parts.graph is None
        assert parts.calibration is None


def test_an_older_signature_does_not_lower_the_serial_number(signed, keys):
    older = (signed / "signature.json").read_bytes()
    sign_bundle(Bundle.open(signed), keys[0], serial=7)
    bundle = Bundle.open(signed, keys=[keys[1]])
    (signed / "signature.json").write_bytes(older)
    sign_bundle(bundle, keys[0])
    assert Bundle.open(signed, keys=[keys[1]], least_serial=8).serial == 8


@pytest.mark.parametrize("text", ["", "{}", "[3]", '{"signed": 3}'])
def test_what_is_no_signature_is_named_where_a_bundle_is_signed(signed, keys, text):
    (signed / "signature.json").write_text(text)
    with pytest.raises(Damaged, match="holds no signature; remove it"):
        sign_bundle(Bundle.open(signed), keys[0])


def killed_at(step: str, monkeypatch) -> None:
    """Let the process end as by a kill in the call of this name."""

    def ends(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(step, ends)


@pytest.mark.parametrize(
    "step",
    [
        "adaptfault.bundle.bundle.sign_versions",
        "adaptfault.bundle.journal.Journal.prepare",
        "adaptfault.bundle.pointer.Pointer.write",
        "adaptfault.bundle.journal.Journal.settle",
    ],
)
def test_a_kill_of_a_signing_run_leaves_what_runs_signed_and_the_next_run_ends_it(
    signed, keys, monkeypatch, step
):
    log = power_cut.broken_log()
    with power_cut.small_versions():
        killed_at(step, monkeypatch)
        with pytest.raises(KeyboardInterrupt):
            maintain(Bundle.open(signed, keys=[keys[1]]), log, sign=keys[0])
        monkeypatch.undo()
        bundle = Bundle.open(signed, keys=[keys[1]])
        running = json.loads((signed / "current.json").read_text())["active"]
        assert Predictor.load(signed, keys=[keys[1]]).version == running
        assert bundle.active().number == running
        maintain(bundle, log, sign=keys[0])
    again = Bundle.open(signed, keys=[keys[1]])
    assert again.active().fault_set == set(power_cut.ROW.cells)
    assert [run["what"] for run in again.journal.runs()].count("deployed") == 1


def test_a_bundle_is_signed_before_it_has_its_name(signed, keys, tmp_path, monkeypatch):
    bundle = Bundle.open(signed)
    parts = bundle.parts
    replace = os.replace
    out = tmp_path / "new.bundle"

    def cut_off(source, target):
        replace(source, target)
        if Path(target) == out:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", cut_off)
    with power_cut.small_versions(), pytest.raises(KeyboardInterrupt):
        Bundle.create(
            out,
            parts.adapter().model,
            parts.adapter(),
            bundle.diagnoser(),
            check=parts.check_windows(),
            sign=keys[0],
        )
    assert Bundle.open(out, keys=[keys[1]]).active().number == 1


def test_a_training_that_was_cut_off_after_its_bundle_was_whole_is_ended_by_the_same_command(
    signed, keys, tmp_path, capsys
):
    save_npz(tmp_path / "grasps.npz", simulate(3, power_cut.LAYOUT, n_frames=20))
    left = tmp_path / ".robot.bundle.training"
    left.mkdir()
    (left / "training.safetensors").touch()
    words = ["train", str(tmp_path / "grasps.npz"), "--out", str(signed), "--quiet"]
    assert main([*words, "--sign", str(write_keys(tmp_path, "other")[0])]) == 3
    assert "not signed by one of the 1 trusted keys" in capsys.readouterr().err
    assert main([*words, "--sign", str(keys[0])]) == 0
    assert "cut off at its end" in capsys.readouterr().out
    assert not left.exists()
    assert main([*words, "--sign", str(keys[0])]) == 3  # a bundle of this name is there
    assert "exists: choose another name" in capsys.readouterr().err
