"""A bundle's life: record, break, maintain, crash, roll back, recover, run out of disk, in any
order (Hypothesis)."""

import errno
import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from unittest import mock

import numpy as np
import power_cut
import pytest
from hypothesis import settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from hypothesis.strategies import booleans, integers, sampled_from

import adaptfault as af
from adaptfault.bundle.pointer import Pointer
from diagnostics import Line, inject, line_fault

ROWS = [line_fault(power_cut.LAYOUT, Line(0, "row", i), "short") for i in range(3)]


class Crash(BaseException):
    """The process ends here, as by kill -9: nothing catches it."""


class Life(RuleBasedStateMachine):
    """One robot. After every step it predicts, its known faults are true ones, and its files do not
    pile up."""

    home: Path  # of a bundle that is made once
    happened: Counter[str]  # in all lives

    @initialize()
    def begin(self):
        self.place = Path(tempfile.mkdtemp())
        shutil.copytree(self.home / power_cut.NAME, self.place / power_cut.NAME)
        self.path = self.place / power_cut.NAME
        self.broken = set()
        self.ever = set()
        self.seed = 100
        self.log = []
        self.x = af.Bundle.open(self.path).parts.check_windows().x
        self.fsync = mock.patch.object(os, "fsync", return_value=None)
        self.fsync.start()

    def teardown(self):
        if hasattr(self, "fsync"):
            self.fsync.stop()
            shutil.rmtree(self.place)

    @rule(row=integers(0, 2))
    def break_row(self, row):
        self.broken.add(row)
        self.ever.add(row)

    @rule(row=integers(0, 2))
    def mend_row(self, row):
        self.broken.discard(row)

    @rule()
    def record(self):
        self.seed += 1
        grasps = af.simulate(
            3, power_cut.LAYOUT, n_frames=40, seed=self.seed, classes=power_cut.CLASSES[1:]
        )
        faults = [ROWS[row] for row in sorted(self.broken)]
        self.log = [inject(frames, faults, power_cut.LAYOUT) for frames in grasps.frames]

    @precondition(lambda self: self.log)
    @rule()
    def maintain(self):
        report = af.maintain(af.Bundle.open(self.path), self.log)
        assert report.exit_code in (0, 1, 2, 3)
        assert report.version == af.Bundle.open(self.path).active().number
        again = af.maintain(af.Bundle.open(self.path), self.log)
        self.happened[report.decision] += 1
        if report.used:
            assert (again.decision, again.fault_set) == ("unchanged", report.fault_set)

    @rule(
        row=integers(0, 2),
        call=sampled_from(["replace", "fsync", "mkdir"]),
        after=integers(0, 6),
        full=booleans(),
    )
    def maintain_until_it_crashes_or_the_disk_is_full(self, row, call, after, full):
        # so that there is something to deploy: a run that deploys nothing writes hardly anything
        self.break_row(row)
        self.record()
        left = [after]
        really = getattr(os, call)

        def failing(*args, **options):
            left[0] -= 1
            if left[0] < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if full else Crash
            return really(*args, **options)

        before = af.Bundle.open(self.path).active().number
        with mock.patch.object(os, call, failing):
            try:
                af.maintain(af.Bundle.open(self.path), self.log)
            except (OSError, Crash) as error:
                self.happened[type(error).__name__] += 1
                assert af.Bundle.open(self.path).active().number in {before, *self.versions()}
            if full:  # prediction does not need the disk
                af.Predictor.load(self.path).predict(self.x)

    @rule()
    def start_and_confirm(self):
        predictor = af.Predictor.load(self.path)
        assert predictor.confirm()
        assert Pointer.read(self.path).probation is False

    @rule()
    def start_and_stop(self):
        af.Predictor.load(self.path)

    @rule()
    def roll_back(self):
        before = Pointer.read(self.path)
        if before.fallbacks:
            assert af.Bundle.open(self.path).rollback().number == before.fallbacks[0]
            self.happened["rollback"] += 1
        else:
            with pytest.raises(ValueError, match="the first"):
                af.Bundle.open(self.path).rollback()

    def versions(self):
        return af.Bundle.open(self.path).versions.numbers

    @invariant()
    def it_predicts_with_finite_probabilities(self):
        if not hasattr(self, "path"):
            return
        bundle = af.Bundle.open(self.path)
        version = bundle.active()
        assert np.isfinite(af.Adaptation.load(version.folder).predict_proba(self.x)).all()
        true = {cell for row in self.ever for cell in ROWS[row].cells}
        assert set(version.fault_set) <= true
        assert set(bundle.known_faults().fault_set) <= true
        assert len(list(self.path.rglob("*"))) < 100
        self.happened["checked"] += 1


def life(home: Path, examples: int, steps: int) -> Counter[str]:
    """Live so many lives; return what happened in them."""
    Life.home = home
    Life.happened = Counter()
    run_state_machine_as_test(
        Life,
        settings=settings(
            max_examples=examples, stateful_step_count=steps, deadline=None, derandomize=True
        ),
    )
    return Life.happened


def test_every_step_of_a_life_does_what_it_says(linear_bundle):
    Life.home = linear_bundle.parent
    Life.happened = Counter()
    one = Life()
    one.begin()
    try:
        one.maintain_until_it_crashes_or_the_disk_is_full(1, "replace", 0, full=False)
        one.maintain_until_it_crashes_or_the_disk_is_full(1, "replace", 0, full=True)
        one.maintain()
        assert af.Bundle.open(one.path).active().fault_set == set(ROWS[1].cells)
        one.start_and_confirm()
        one.roll_back()
        one.it_predicts_with_finite_probabilities()
        assert one.happened == {
            "Crash": 1,
            "OSError": 1,
            "deployed": 1,
            "rollback": 1,
            "checked": 1,
        }
        one.ever.clear()  # so that the known faults are false ones
        with pytest.raises(AssertionError):
            one.it_predicts_with_finite_probabilities()
    finally:
        one.teardown()


def test_whatever_happens_in_its_life_a_bundle_opens_and_predicts(linear_bundle):
    assert life(linear_bundle.parent, 3, 8)["checked"] > 3


@pytest.mark.slow
def test_whatever_happens_in_its_long_life_a_bundle_opens_and_predicts(linear_bundle):
    happened = life(linear_bundle.parent, 60, 40)
    assert set(happened) >= {"deployed", "unchanged", "Crash", "OSError", "rollback"}
