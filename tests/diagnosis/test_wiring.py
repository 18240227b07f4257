from dataclasses import replace

import numpy as np
import pytest

from adaptfault.data.simulated_grasps import simulate
from adaptfault.viewers.ros_diagnostics import diagnostic_array, stale_array
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    Line,
    Monitor,
    SelfDiagnosis,
    SensorLayout,
    Verdict,
    inject,
)
from diagnostics.decision.line_cover import Cause, solve

TRIANGLES = {f"triangle {i}": list(range(10 * i, 10 * i + 10)) for i in range(8)}
CONNECTORS = {
    "connector J3": [f"triangle {i}" for i in range(4)],
    "connector J4": [f"triangle {i}" for i in range(4, 8)],
}
SKIN = SensorLayout(
    1, 8, 10, groups=TRIANGLES | CONNECTORS | {"board A": ["connector J3", "connector J4"]}
)


def explained(
    dead: object, untested: object = (), layout: SensorLayout = SKIN
) -> tuple[Cause, ...]:
    every = np.arange(layout.n_cells)
    faulty = np.isin(every, dead)
    consistent = np.isin(every, np.r_[dead, untested].astype(int))
    return solve(faulty, consistent, ~consistent, 8.0 * faulty, layout)


def test_with_groups_the_wires_are_the_groups_from_the_inside_out():
    assert [str(line) for line in SKIN.lines] == [*TRIANGLES, *CONNECTORS, "board A"]
    connector = SKIN.lines[8]
    assert SKIN.cells_on(connector).tolist() == list(range(40))
    assert [str(line) for line in SKIN.parts(connector)] == list(TRIANGLES)[:4]
    assert SKIN.place(42) == "triangle 4, cell 42"


def test_on_a_bus_each_pad_is_one_wire():
    layout = SensorLayout(3, 1, 12, wiring="bus")
    assert layout.lines == tuple(Line(pad, "bus", 0) for pad in range(3))
    assert layout.cells_on(Line(1, "bus", 0)).tolist() == list(range(12, 24))
    assert layout.place(13) == "pad 1, cell 13"


def test_positions_without_a_cell_are_in_no_group():
    present = np.ones(80, bool)
    present[[0, 5]] = False
    layout = replace(SKIN, present=present)
    assert layout.cells_on(layout.lines[0]).tolist() == [1, 2, 3, 4, 6, 7, 8, 9]


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        ({"a": [0, 1, 2], "b": [2, 3]}, "'a' and 'b' overlap, and neither contains the other"),
        ({"a": [0, 1], "b": ["a", "c"]}, "names 'c', which is no group"),
        ({"a": [0, 99]}, "cell 99: use whole numbers from 0 to 23"),
        ({"a": [0, True]}, "cell True"),
        ({"a": ["b"], "b": ["a"]}, "contains itself: a > b > a"),
        ({"a": []}, "'a' needs a list of cells"),
        ({"a": "b", "b": [0]}, "'a' needs a list of cells"),
        ([0, 1], "groups are lists of cells"),
    ],
)
def test_groups_that_make_no_sense_are_refused_in_one_line(groups: object, said: str):
    with pytest.raises(ValueError, match=said) as refused:
        SensorLayout(2, 3, 4, groups=groups)  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)


def test_a_group_over_parts_of_two_buses_is_refused():
    with pytest.raises(ValueError, match="'chip' and 'pad 0, bus' overlap"):
        SensorLayout(2, 1, 4, wiring="bus", groups={"chip": [3, 4]})
    both = SensorLayout(2, 1, 4, wiring="bus", groups={"chip": [0, 1], "board": list(range(8))})
    assert [str(line) for line in both.lines] == ["chip", "pad 0, bus", "pad 1, bus", "board"]


def test_an_unknown_wiring_or_rest_is_refused():
    for wrong, said in (
        ({"wiring": "star"}, "wiring is one of matrix, bus"),
        ({"rest": "up"}, "rest is one of low"),
    ):
        with pytest.raises(ValueError, match=said):
            SensorLayout(1, 2, 2, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="groups="):
        SensorLayout(1, 2, 2, wiring={"a": [0]})  # type: ignore[arg-type]


def test_declared_wiring_survives_json_and_the_default_adds_no_field():
    for layout in (SKIN, SensorLayout(2, 2, 2, wiring="bus", rest="high")):
        again = SensorLayout.from_dict(layout.to_dict())
        assert again == layout
        assert hash(again) == hash(layout)
        assert again.lines == layout.lines
    assert replace(SKIN, groups=TRIANGLES) != SKIN
    assert set(SensorLayout(2, 2, 2).to_dict()) == {
        "schema",
        "pads",
        "rows",
        "cols",
        "full_scale",
        "unit",
        "rate",
    }


def test_the_fault_of_a_group_survives_json():
    fault = Fault(FaultKind.OPEN, (0, 1), line=SKIN.lines[0])
    assert Fault.from_dict(fault.to_dict()) == fault
    assert "name" not in Fault(FaultKind.OPEN, (0, 1), line=Line(0, "row", 0)).to_dict()["line"]


def test_a_group_whose_cells_are_faulty_is_one_cause():
    for line in SKIN.lines:
        (cause,) = explained(SKIN.cells_on(line))
        assert (cause.line, cause.cells) == (line, tuple(SKIN.cells_on(line).tolist()))


def test_of_groups_that_explain_the_same_cells_the_innermost_is_named():
    (cause,) = explained(np.arange(10), untested=np.arange(10, 80))
    assert str(cause.line) == "triangle 0"


def test_untested_groups_beside_dead_ones_are_inferred_where_that_is_cheaper():
    (cause,) = explained(np.arange(30), untested=np.arange(30, 40))
    assert str(cause.line) == "connector J3"
    assert cause.cells == tuple(range(40))
    assert {str(c.line) for c in explained(np.arange(30))} == {
        "triangle 0",
        "triangle 1",
        "triangle 2",
    }


def test_scattered_cells_are_no_group():
    causes = explained([0, 13, 27, 31, 65])
    assert [cause.line for cause in causes] == [None] * 5


@pytest.mark.parametrize("seed", range(20))
def test_random_dead_groups_and_cells_are_named_exactly(seed: int):
    rng = np.random.default_rng(seed)
    triangles = rng.choice(8, 3, replace=False)
    single = rng.choice(np.setdiff1d(np.arange(8), triangles)) * 10 + 4
    dead = np.r_[np.concatenate([np.arange(10 * i, 10 * i + 10) for i in triangles]), single]
    causes = explained(dead)
    assert {c for cause in causes for c in cause.cells} == set(dead.tolist())
    assert {str(cause.line) for cause in causes} == {f"triangle {i}" for i in triangles} | {"None"}


# ---- on simulated grasps
# -------------------------------------------------------------------------------------------

BLOCKS = {
    f"triangle {3 * r + c}": [(4 * r + i) * 12 + 4 * c + j for i in range(4) for j in range(4)]
    for r in range(3)
    for c in range(3)
}
FLEX = {f"connector J{r}": [f"triangle {3 * r + c}" for c in range(3)] for r in range(3)}
WIRED = SensorLayout(1, 12, 12, groups=BLOCKS | FLEX)


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    return [
        np.asarray(f, float)
        for f in simulate(6, replace(WIRED, groups=None), n_frames=60, seed=5).frames
    ]


@pytest.fixture(scope="module")
def fitted(grasps: list[np.ndarray]) -> SelfDiagnosis:
    return SelfDiagnosis(WIRED).fit(grasps[::2])


def silenced(log: list[np.ndarray], cells: object, value: float = np.nan) -> list[np.ndarray]:
    log = [frames.copy() for frames in log]
    for frames in log:
        frames[:, cells] = value
    return log


def names_no_row(diagnosis: Diagnosis) -> bool:
    told = [
        str(diagnosis),
        *(f.describe(diagnosis.layout) for f in diagnosis.faults),
        *diagnosis.coverage.advice,
    ]
    return not any(word in text for text in told for word in ("row", "column", "bridge", "address"))


@pytest.mark.parametrize("value", [np.nan, 0.0, 5.0])
def test_a_dead_connector_is_one_fault_that_says_what_to_do(
    fitted: SelfDiagnosis, grasps: list[np.ndarray], value: float
):
    cells = [cell for name in FLEX["connector J1"] for cell in BLOCKS[name]]
    diagnosis = fitted.diagnose(silenced(grasps[1:24:2], cells, value))
    fault, *others = diagnosis.faults
    assert all(other.line is None for other in others)
    assert str(fault.line) == "connector J1"
    assert sorted(fault.cells) == sorted(cells)
    assert fault.reason.startswith("reseat connector J1: all 3 triangles behind it are ")
    assert ("silent" in fault.reason) == np.isnan(value)
    assert diagnosis.exit_code == 2
    assert names_no_row(diagnosis)
    assert Diagnosis.from_dict(diagnosis.to_dict()).faults == diagnosis.faults


def test_a_dead_row_of_a_skin_without_rows_is_no_wire(
    fitted: SelfDiagnosis, grasps: list[np.ndarray]
):
    diagnosis = fitted.diagnose(silenced(grasps[1:24:2], np.arange(60, 72)))
    assert set(diagnosis.fault_set) == set(range(60, 72))
    assert all(fault.line is None for fault in diagnosis.faults)
    assert names_no_row(diagnosis)


def test_two_rows_that_read_the_same_are_no_bridge_where_there_are_no_rows(
    grasps: list[np.ndarray],
):
    log = [frames.copy() for frames in grasps[1:24:2]]
    for frames in log:
        frames[:, 60:72] = frames[:, 72:84]
    found = {}
    for name, layout in (
        ("matrix", replace(WIRED, groups=None)),
        ("bus", replace(WIRED, groups=None, wiring="bus")),
    ):
        found[name] = SelfDiagnosis(layout).diagnose(log).faults
    assert any(fault.kind is FaultKind.ALIAS for fault in found["matrix"])
    assert all(fault.kind is not FaultKind.ALIAS for fault in found["bus"])


def test_the_monitor_names_the_group_and_the_wiring_is_stored(
    fitted: SelfDiagnosis, grasps: list[np.ndarray]
):
    again = SelfDiagnosis.from_state(*fitted.state())
    assert again.layout == WIRED
    log = np.concatenate(silenced(grasps[1:12:2], BLOCKS["triangle 4"]))
    monitor = Monitor(again, wait=True)
    told = [fault for frame in log for fault in monitor.update(frame)]
    assert str(told[0].line) == "triangle 4"
    assert monitor.diagnosis().faults == again.diagnose(log).faults


@pytest.mark.slow
@pytest.mark.parametrize("kind", [FaultKind.OPEN, FaultKind.SHORT])
def test_a_dead_bus_is_one_fault_or_its_pad_was_not_touched(grasps: list[np.ndarray], kind):
    layout = SensorLayout(3, 4, 12, wiring="bus")
    fitted = SelfDiagnosis(layout).fit(grasps[::2])
    dead = Fault(kind, tuple(range(48, 96)))
    log = [inject(frames, [dead], layout) for frames in grasps[1:24:2]]
    diagnosis = fitted.diagnose(log)
    first = (*diagnosis.faults, *diagnosis.possible)[0]
    assert first.line == Line(1, "bus", 0)
    # at rest it reads as a pad that nothing touches
    assert (first in diagnosis.faults) == (kind is FaultKind.SHORT)
    assert diagnosis.verdicts[48] is not Verdict.ALIVE


def test_ros_has_one_status_for_the_groups_of_each_pad(
    fitted: SelfDiagnosis, grasps: list[np.ndarray]
):
    diagnosis = fitted.diagnose(silenced(grasps[1:12:2], BLOCKS["triangle 4"]))
    statuses = {status["name"]: status for status in diagnostic_array(diagnosis)["status"]}
    assert set(statuses) == {"tactile: pad 0", "tactile: pad 0 groups", "tactile: stream"}
    assert statuses["tactile: pad 0 groups"]["message"] == "triangle 4"
    assert [status["name"] for status in stale_array(WIRED)["status"]] == list(statuses)
