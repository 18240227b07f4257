"""The ablations remove rules that are in the code."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from ablations import PACKAGE, RULES, without


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_is_in_the_code_once_and_what_is_left_without_it_compiles(rule: str, tmp_path: Path):
    file, old, _ = RULES[rule]
    changed = (without(rule, tmp_path) / PACKAGE.name / file).read_text()
    assert (changed == (PACKAGE / file).read_text()) == (not old)
    compile(changed, file, "exec")


def test_a_rule_that_is_not_in_the_code_is_refused(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(RULES, "jumps", ("evidence/jumps.py", "no such text", ""))
    with pytest.raises(SystemExit, match=r"jumps: evidence/jumps\.py holds 0 times, not once"):
        without("jumps", tmp_path)
