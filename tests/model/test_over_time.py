"""Evidence over time: what one unit may count for, and since when a fault is there."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from diagnostics.model.over_time import Units, for_good, now_and_then, since, throughout
from diagnostics.model.record import UNIT

ODD = 0.01


def units(pieces: int, odd: float = ODD, recordings: int = 1) -> Units:
    of_piece = np.arange(pieces) // UNIT
    begins = np.flatnonzero(np.diff(of_piece, prepend=-1))
    opens = np.arange(len(begins)) % -(-len(begins) // recordings) == 0
    return Units(begins, of_piece, np.full((len(begins), 1), odd), opens)


RATIOS = st.lists(st.floats(-200, 200), min_size=1, max_size=40).map(
    lambda values: np.array(values)[:, None]
)


@given(RATIOS)
def test_no_unit_counts_for_more_than_a_healthy_cell_is_rarely_odd(ratio):
    of = units(len(ratio))
    most = len(of.begins) * np.log((1 - ODD) / ODD)
    for evidence in (throughout(ratio, of), for_good(ratio, of), now_and_then(ratio, of)):
        assert np.isfinite(evidence).all()
        assert evidence[0] <= most + 1e-6


@given(st.integers(0, 39), st.integers(2, 40))
def test_a_fault_that_lasts_begins_where_the_evidence_turns(begin, pieces):
    begin = min(begin, pieces - 1)
    ratio = np.where(np.arange(pieces) < begin, -4.0, 4.0)[:, None]
    # so rare that a unit counts for what its pieces say
    assert since(ratio, units(pieces, 1e-30))[0] == begin


def test_a_fault_since_the_start_needs_no_search_for_its_onset():
    ratio = np.full((40, 1), 0.5)
    late = np.where(np.arange(40) < 20, 0.0, 1.0)[:, None]
    assert for_good(ratio, units(40))[0] > for_good(late, units(40))[0]


def test_what_comes_and_goes_is_found_where_what_lasts_is_not():
    on = (np.arange(80) // UNIT) % 2 == 0
    ratio = np.where(on, 3.0, -3.0)[:, None]
    assert now_and_then(ratio, units(80))[0] > 4
    assert throughout(ratio, units(80))[0] < 1e-6


@given(st.permutations([True, False] * 6))
def test_of_what_comes_and_goes_only_one_stretch_that_has_gone_is_none(dead):
    of_recording = np.repeat(dead, 2 * UNIT)
    ratio = np.where(of_recording, 2.0, -2.0)[:, None]
    of_log = replace(units(len(ratio), recordings=12), goes=8.0)
    evidence = now_and_then(ratio, of_log)[0]
    stretches = (np.diff([False, *dead]) & np.array(dead)).sum()
    assert evidence > 4 or stretches < 3
    assert evidence < 0 or stretches > 1 or dead[-1]


def test_a_fault_of_whole_recordings_is_found_however_few_of_them_have_it():
    dead = np.repeat(np.arange(12) % 3 == 2, 3 * UNIT)
    ratio = np.where(dead, 0.3, -3.0)[:, None]
    assert now_and_then(ratio, units(len(ratio), recordings=12))[0] > 4
