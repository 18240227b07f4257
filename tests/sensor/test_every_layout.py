"""Every public call that takes a layout ends well on every kind of layout, whatever its size and
wiring."""

import json

import numpy as np
import pytest
from conftest import fit_of
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adaptfault import CellImputer, Restorer, correct, make_windows, simulate, summarise
from adaptfault.data.windows import recordings_of
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    FaultSet,
    Monitor,
    SelfDiagnosis,
    SensorLayout,
    bridge,
    freeze_stream,
    inject,
    line_fault,
    lose_frames,
)
from diagnostics.sensor.recalibration import find_recalibration
from diagnostics.sensor.sensor_change import find_change

RECORDINGS = 12
FRAMES = 48


@pytest.fixture(scope="module", autouse=True)
def hardly_fitted():
    """Let a fit take hardly any step: that it ends well is what is proven."""
    with fit_of(20, 2):
        yield


@st.composite
def layouts(draw: st.DrawFn) -> SensorLayout:
    """Any kind of layout: rows and columns, buses, groups or several axes, with any position
    masked."""
    shape = draw(st.tuples(st.integers(1, 2), st.integers(1, 4), st.integers(1, 4)))
    axes = draw(st.sampled_from([1, 1, 1, 3]))
    present = draw(st.none() | npst.arrays(bool, shape).filter(np.any))
    wiring = draw(st.sampled_from(["matrix", "bus"]))
    rest = draw(st.sampled_from(["learn", "low", "high", "middle"]))
    groups = draw(st.none() | st.integers(1, 3))
    if groups is not None:  # parts of a pad, of whole positions: neither overlaps another line
        positions = np.arange(np.prod(shape) * axes).reshape(shape[0], -1, axes)
        parts = [
            part.ravel().tolist()
            for pad in positions
            for part in np.array_split(pad, groups)
            if len(part)
        ]
        groups = {f"group {i}": part for i, part in enumerate(parts)}
        groups["board"] = list(groups)
    unit = draw(
        st.sampled_from(
            [{"full_scale": 5.0}, {"full_scale": 4095.0, "unit": "count", "rate": 31.25}]
        )
    )
    return SensorLayout(
        *shape, axes=axes, present=present, wiring=wiring, rest=rest, groups=groups, **unit
    )


def touched(layout: SensorLayout, seed: int) -> list[np.ndarray]:
    """Recordings of round touches here and there, in counts of a converter of 12 bits."""
    rng = np.random.default_rng(seed)
    log = []
    row, col = (place.ravel() for place in np.indices(layout.shape)[1:])
    for _ in range(RECORDINGS):
        r = rng.uniform(0, layout.rows)
        c = rng.uniform(0, layout.shape[2])
        load = np.exp(-((row - r) ** 2 + (col - c) ** 2) / 4) * rng.uniform(0.2, 0.8)
        force = np.sin(np.linspace(0, np.pi, FRAMES)).clip(0.2) - 0.2
        share = 0.02 + force[:, None] * load + rng.normal(0, 0.001, (FRAMES, layout.n_cells))
        if layout.rest == "high":
            share = 1 - share
        if layout.rest == "middle" or layout.axes > 1:
            share = 0.5 + (share - 0.02) / 2
        log.append(np.rint(share.clip(0, 1) * 4095) / 4095 * layout.full_scale)
    return log


KINDS = [
    SensorLayout(1, 3, 4, wiring="bus"),
    SensorLayout(1, 3, 4, groups={"left": range(6), "right": range(6, 12)}),
    SensorLayout(1, 1, 1),
    SensorLayout(1, 1, 1, wiring="bus"),
    SensorLayout(1, 1, 8),
    SensorLayout(1, 8, 1),
    SensorLayout(8, 1, 1),
    SensorLayout(1, 1, 8, wiring="bus"),
    SensorLayout(1, 2, 2, axes=3),
    SensorLayout(2, 2, 2, axes=3, groups={"board": range(24)}),
    SensorLayout(1, 1, 1, axes=3),
    SensorLayout(2, 4, 4, present=np.indices((2, 4, 4))[1:].sum(axis=0) > 0),
    SensorLayout(2, 3, 3),
    SensorLayout(2, 3, 3, wiring="bus"),
]


def some_faults(layout: SensorLayout, seed: int) -> list[Fault]:
    """One cell of each kind of fault, and one wire."""
    rng = np.random.default_rng(seed)
    present = np.flatnonzero(layout.present)
    value = {FaultKind.STUCK: layout.full_scale / 3}
    kinds = [kind for kind in FaultKind if kind is not FaultKind.ALIAS]
    faults = [Fault(kind, (int(rng.choice(present)),), value=value.get(kind)) for kind in kinds]
    lines = [line for line in layout.lines if len(layout.cells_on(line))]
    return [*faults, line_fault(layout, lines[int(rng.integers(len(lines)))], FaultKind.OPEN)]


FITTED: dict[str, SelfDiagnosis] = {}


def fitted_on(layout: SensorLayout) -> SelfDiagnosis:
    """The diagnosis of a layout, fitted once."""
    name = json.dumps(layout.to_dict())
    if name not in FITTED:
        FITTED[name] = SelfDiagnosis(layout).fit(touched(layout, 1))
    return FITTED[name]


every_kind = [example(layout) for layout in KINDS]


def on_every_kind(drawn: int = 15):
    """Try a test on one layout of each kind, and on some that Hypothesis draws."""

    def decorate(test):
        for one in every_kind:
            test = one(test)
        return settings(max_examples=drawn)(given(layouts())(test))

    return decorate


@on_every_kind()
def test_every_method_of_a_layout_ends_well(layout: SensorLayout):
    assert sum(len(layout.cells_on(line)) > 0 for line in layout.lines) > 0
    for line in layout.lines:
        assert str(line)
        assert set(layout.parts(line)) <= set(layout.lines)
        assert layout.present.ravel()[layout.cells_on(line)].all()
    for cell in range(layout.n_cells):
        assert layout.cell(*layout.position(cell), cell % layout.axes) == cell
        assert layout.place(cell)
    assert layout.pad_of.shape == (layout.n_cells,)
    assert layout.beside.shape == (layout.n_cells, 8)
    every = np.ones(layout.n_cells, bool)
    assert layout.with_neighbours(every).all()
    assert (layout.connected(every) > 0).all()
    assert SensorLayout.from_dict(json.loads(json.dumps(layout.to_dict()))) == layout
    assert str(layout)


@on_every_kind()
def test_every_fault_is_injected_and_no_reading_leaves_the_range(layout: SensorLayout):
    recording = touched(layout, 0)[0]
    faults = some_faults(layout, 0)
    for line in layout.lines:
        if line.kind in ("row", "column") and line.index + 1 < layout.rows * (line.kind == "row"):
            faults.append(bridge(layout, line))
        if line.kind in ("row_address", "column_address"):
            cells, _ = layout.misaddressed(line, 1)
            if len(cells):
                faults.append(line_fault(layout, line, FaultKind.ALIAS, value=1))
    for fault in faults:
        broken = inject(recording, [fault], layout, seed=1, dither=0.01, gain=0.1)
        assert broken.shape == recording.shape
        assert ((broken >= 0) & (broken <= layout.full_scale)).all()
    assert np.isnan(lose_frames(recording, 0.25, seed=0)).all(axis=1).sum() == FRAMES // 4
    assert (freeze_stream(recording, 10)[10:] == recording[10]).all()


def tried(diagnosis: Diagnosis, layout: SensorLayout) -> None:
    """Call every method of a diagnosis."""
    again = Diagnosis.from_dict(json.loads(json.dumps(diagnosis.to_dict(), allow_nan=False)))
    assert again.fault_set == diagnosis.fault_set
    assert str(diagnosis) == str(again)
    assert diagnosis.verdicts.shape == diagnosis.probability.shape == (layout.n_cells,)
    assert ((diagnosis.probability >= 0) & (diagnosis.probability <= 1)).all()
    assert not diagnosis.fault_set.mask[~layout.present.ravel()].any()
    assert 0 <= diagnosis.coverage.test_coverage <= 1
    assert str(diagnosis.coverage)
    assert diagnosis.map
    assert diagnosis.exit_code in (0, 1, 2)
    assert diagnosis.fault_set <= diagnosis.suspects(0.0) | diagnosis.fault_set
    assert diagnosis.disturbed >= diagnosis.statically_loaded
    assert isinstance(diagnosis.frozen, tuple)


@on_every_kind(2)
def test_every_call_of_the_diagnosis_ends_well_with_a_reference_and_without(layout: SensorLayout):
    later = touched(layout, 2)[: RECORDINGS // 4]
    broken = [inject(frames, some_faults(layout, 3), layout, seed=4) for frames in later]
    cold = SelfDiagnosis(layout)
    fitted = fitted_on(layout)
    again = SelfDiagnosis.from_state(*fitted.state())
    for log in ([np.full_like(later[0], np.nan), *broken], [frames[:1] for frames in later]):
        for diagnoser in (cold, fitted):
            diagnosis = diagnoser.diagnose(log)
            tried(diagnosis, layout)
            found = diagnoser.rewiring(log)
            if found is not None:
                assert sorted(found.source.tolist()) == list(range(layout.n_cells))
                assert layout.is_matrix or layout.pads > 1
        assert again.diagnose(log).to_dict() == diagnosis.to_dict()
    monitor = Monitor(fitted, wait=True)
    for frame in broken[0]:
        monitor.update(frame)
    assert monitor.diagnosis().fault_set == fitted.diagnose(broken[0]).fault_set
    assert again.set_params(false_discovery_rate=0.01).reference_ is None


@pytest.mark.parametrize("layout", [layout for layout in KINDS if layout.axes == 1], ids=str)
def test_changes_of_the_sensor_are_looked_for_on_every_kind(layout: SensorLayout):
    healthy = touched(layout, 1)
    later = [np.minimum(1.5 * frames, layout.full_scale) for frames in touched(layout, 2)]
    reference = fitted_on(layout).reference_
    none = np.zeros(layout.n_cells, bool)
    for excluded in (none, ~none):
        replaced = find_recalibration(later, healthy, reference, layout, excluded, none)
        change = find_change(
            later, healthy, layout, FaultSet(np.flatnonzero(excluded), layout.n_cells)
        )
        assert replaced is None or set(replaced.pads) <= set(range(layout.pads))
        assert change is None or change.pad in (None, *range(layout.pads))
    assert change is None  # of no cell


@pytest.mark.parametrize("layout", KINDS, ids=str)
def test_the_map_of_a_diagnosis_is_drawn_on_every_kind(layout: SensorLayout):
    plt = pytest.importorskip("matplotlib.pyplot")
    picture = SelfDiagnosis(layout).diagnose(touched(layout, 1)).plot()
    assert picture.axes
    plt.close("all")


@on_every_kind()
def test_windows_restored_and_corrected_readings_and_simulated_grasps_are_had_on_every_kind(
    layout: SensorLayout,
):
    healthy = touched(layout, 1)
    windows = make_windows(healthy, np.arange(len(healthy)) % 2, layout)
    assert windows.x.shape[1:] == (10, layout.n_cells)
    assert len(recordings_of(windows, layout)) == len(healthy)
    assert correct(windows.x).shape == windows.x.shape
    assert str(summarise(healthy, layout))
    assert json.dumps(summarise(healthy, layout).to_dict(), allow_nan=False)
    first = int(np.flatnonzero(layout.present)[0])
    restorer = Restorer(layout).fit(healthy)
    for cells in ((first,), tuple(np.flatnonzero(layout.present).tolist())):
        lost = FaultSet(cells, layout.n_cells)
        restored, error = restorer.transform(healthy[0], lost, return_std=True)
        assert np.isfinite(restored).all()
        assert np.isfinite(error).all()
        assert np.isfinite(restorer.update(healthy[0][0], lost)).all()
        filled = CellImputer(lost).fit(np.concatenate(healthy)).transform(healthy[0])
        assert np.isfinite(filled).all()
    if layout.axes > 1:
        with pytest.raises(ValueError, match="cells of one axis"):
            simulate(1, layout, n_frames=12, seed=1)
    else:
        assert np.isfinite(np.concatenate(simulate(1, layout, n_frames=12, seed=1).frames)).all()
