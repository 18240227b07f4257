import pytest

from adaptfault.data.json_lines import Lines


def test_documents_come_back_in_order(tmp_path):
    lines = Lines(tmp_path / "run.jsonl")
    assert lines.read() == []
    for document in ({"a": 1}, [2], "three\nlines"):
        lines.add(document)
    assert Lines(lines.path).read() == [{"a": 1}, [2], "three\nlines"]


@pytest.mark.parametrize("cut", range(1, 8))
def test_what_a_kill_left_of_a_line_is_dropped_and_the_next_one_is_whole(tmp_path, cut):
    lines = Lines(tmp_path / "run.jsonl")
    lines.add({"a": 1})
    lines.add({"b": 2})
    lines.path.write_bytes(lines.path.read_bytes()[:-cut])
    assert lines.read() == [{"a": 1}]
    lines.add({"c": 3})
    assert lines.read() == [{"a": 1}, {"c": 3}]


def test_a_new_beginning_drops_the_old_lines(tmp_path):
    lines = Lines(tmp_path / "run.jsonl")
    lines.add(1)
    lines.begin(2)
    assert lines.read() == [2]


def test_a_line_that_is_not_json_is_named(tmp_path):
    (tmp_path / "run.jsonl").write_text('{"a": 1}\nnonsense\n')
    with pytest.raises(ValueError, match=r"run.jsonl, line 2: not JSON"):
        Lines(tmp_path / "run.jsonl").read()
