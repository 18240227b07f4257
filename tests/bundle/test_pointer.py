import pytest

from adaptfault.bundle.pointer import Pointer


def test_a_pointer_comes_back(tmp_path):
    pointer = Pointer(3, (2, 1), True, 1, "me", ((4, 5), ()))
    pointer.write(tmp_path)
    assert Pointer.read(tmp_path) == pointer


def test_a_new_version_is_on_probation_and_the_one_before_is_its_fallback():
    pointer = Pointer(1).deployed(2)
    assert (pointer.active, pointer.fallbacks, pointer.probation, pointer.starts) == (
        2,
        (1,),
        True,
        0,
    )
    assert pointer.started("a").started("a").starts == 1
    assert pointer.started("a").started("b").starts == 2
    assert not pointer.started("a").confirmed().probation


def test_a_version_that_was_never_confirmed_is_no_fallback():
    assert Pointer(1).deployed(2).deployed(3).fallbacks == (1,)
    assert Pointer(1).deployed(2).confirmed().deployed(3).fallbacks == (2, 1)


def test_a_confirmed_version_does_not_count_starts():
    assert Pointer(1).started("a") == Pointer(1)


def test_falling_back_remembers_what_was_rejected_and_the_first_cannot_fall_back():
    back = Pointer(1).deployed(2).fallen_back((7, 8))
    assert (back.active, back.fallbacks, back.probation, back.rejected) == (1, (), False, ((7, 8),))
    with pytest.raises(ValueError, match="version 1 is the first"):
        back.fallen_back(())
