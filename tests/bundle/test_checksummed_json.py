import json

import pytest

from adaptfault.bundle.checksummed_json import (
    Damaged,
    Sealed,
    damage,
    decoding,
    read_checksummed,
    read_with_copy,
    write_checksummed,
    write_files,
    write_with_copy,
)
from adaptfault.models.builders import ModelNotAllowed

SCHEMA = "adaptfault.test/1"
DOCUMENT = {"schema": SCHEMA, "numbers": [1, 2.5, None], "text": "pad 0"}


def flip(path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(bytes(data))


def test_a_document_comes_back(tmp_path):
    write_checksummed(tmp_path / "a.json", DOCUMENT)
    assert read_checksummed(tmp_path / "a.json", SCHEMA) == DOCUMENT


def test_every_flipped_bit_is_noticed(tmp_path):
    path = tmp_path / "a.json"
    write_checksummed(path, DOCUMENT)
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        flip(path, bit)
        with pytest.raises(Damaged):
            read_checksummed(path, SCHEMA)
        path.write_bytes(whole)
    assert read_checksummed(path, SCHEMA) == DOCUMENT


@pytest.mark.parametrize("data", [b"", b"{}", b"[1]", b"null", b'{"sha256": "x"}', b"\xff\xfe"])
def test_what_is_no_sealed_document_is_damaged(tmp_path, data):
    (tmp_path / "a.json").write_bytes(data)
    with pytest.raises(Damaged):
        read_checksummed(tmp_path / "a.json", SCHEMA)


def test_a_document_of_another_schema_is_refused(tmp_path):
    write_checksummed(tmp_path / "a.json", DOCUMENT)
    with pytest.raises(Damaged, match="expected 'adaptfault"):
        read_checksummed(tmp_path / "a.json", "adaptfault.other/1")


def test_what_json_lacks_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_checksummed(tmp_path / "a.json", {**DOCUMENT, "x": float("nan")})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("broken", ["a.json", "a.copy.json"])
def test_a_damaged_document_is_read_from_its_copy_and_mended(tmp_path, broken):
    path = tmp_path / "a.json"
    write_with_copy(path, DOCUMENT)
    flip(tmp_path / broken, 100)
    assert read_with_copy(path, SCHEMA) == DOCUMENT
    assert any(broken in problem for problem in damage(path, SCHEMA, repair=False))
    assert damage(path, SCHEMA, repair=True)
    assert damage(path, SCHEMA, repair=True) == []
    assert json.loads((tmp_path / broken).read_bytes())["text"] == "pad 0"


def test_a_missing_document_and_two_damaged_ones_are_told_apart(tmp_path):
    path = tmp_path / "a.json"
    with pytest.raises(FileNotFoundError):
        read_with_copy(path, SCHEMA)
    write_with_copy(path, DOCUMENT)
    flip(path, 100)
    flip(tmp_path / "a.copy.json", 100)
    with pytest.raises(Damaged, match="both"):
        read_with_copy(path, SCHEMA)


def test_a_changed_or_missing_file_is_noticed(tmp_path):
    sealed = Sealed(tmp_path, write_files(tmp_path, {"sub/weights": b"abc", "other": b"c"}))
    sealed.check()
    assert sealed.below("sub").read("weights") == sealed.read("sub/weights") == b"abc"
    (tmp_path / "sub" / "weights").write_bytes(b"abd")
    with pytest.raises(Damaged, match="damaged"):
        sealed.check()
    with pytest.raises(Damaged, match="damaged"):
        sealed.below("sub").read("weights")
    (tmp_path / "sub" / "weights").unlink()
    with pytest.raises(Damaged, match="missing"):
        sealed.check()
    (tmp_path / "more").write_bytes(b"abc")
    with pytest.raises(FileNotFoundError, match="none of the recorded files"):
        sealed.read("more")
    with pytest.raises(PermissionError, match="is not written again"):
        sealed.write("other", b"")


def test_a_model_that_is_not_allowed_is_not_damaged(tmp_path):
    with pytest.raises(ModelNotAllowed, match=r"^not allowed"), decoding(tmp_path):
        raise ModelNotAllowed("not allowed")
    with pytest.raises(Damaged, match="is damaged: KeyError"), decoding(tmp_path):
        raise KeyError("x")
