"""Properties that hold for any layout, fault set, packet, recording and document, on examples that
Hypothesis draws."""

import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adaptfault.acquisition import PacketError, format_packet, parse_packet
from adaptfault.acquisition.packet import DEVICE
from adaptfault.bundle.checksummed_json import (
    Damaged,
    damage,
    read_checksummed,
    read_with_copy,
    write_checksummed,
    write_with_copy,
)
from adaptfault.bundle.journal import Entry, Journal
from adaptfault.bundle.pointer import Pointer
from adaptfault.data.recordings import InputError, Recordings, load, save_npz
from diagnostics import Fault, FaultKind, FaultSet, SensorLayout, inject, line_fault

SCHEMA = "test.document/1"
FINITE = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.text(st.characters(exclude_categories=["C", "Z"]), max_size=12)


@st.composite
def layouts(draw: st.DrawFn, most: int = 6) -> SensorLayout:
    """Any layout of at most 2 pads of ``most`` by ``most`` positions, with some of them masked."""
    shape = draw(st.tuples(st.integers(1, 2), st.integers(1, most), st.integers(1, most)))
    present = draw(npst.arrays(bool, shape).filter(np.any))
    full_scale, rate = (draw(st.floats(0.5, 65535)) for _ in range(2))
    return SensorLayout(
        *shape, full_scale=full_scale, unit=draw(WORDS) or "N", rate=rate, present=present
    )


@st.composite
def fault_sets(draw: st.DrawFn, n_cells: int = 12) -> FaultSet:
    return FaultSet(tuple(draw(st.sets(st.integers(0, n_cells - 1)))), n_cells)


@st.composite
def recordings(draw: st.DrawFn) -> Recordings:
    """One to three recordings with labels, names and missing readings."""
    layout = draw(layouts(4))
    lengths = draw(st.lists(st.integers(1, 4), min_size=1, max_size=3))
    readings = st.floats(0, np.float32(layout.full_scale).item(), width=32).filter(
        lambda x: x <= layout.full_scale
    )
    frames = []
    for length in lengths:
        values = draw(npst.arrays(np.float32, (length, layout.n_cells), elements=readings))
        values[draw(npst.arrays(bool, values.shape))] = np.nan
        values[0] = 0.0  # one frame is whole
        frames.append(values * layout.present.ravel())
    names = draw(st.lists(WORDS.filter(bool), min_size=1, max_size=4, unique=True))
    labels = draw(npst.arrays(np.int64, len(lengths), elements=st.integers(0, len(names) - 1)))
    return Recordings(
        tuple(frames), layout, labels, tuple(names), tuple(f"r{i}" for i in range(len(lengths)))
    )


# Layouts


@given(layouts())
def test_a_cell_and_its_position_name_each_other(layout: SensorLayout):
    positions = [layout.position(cell) for cell in range(layout.n_cells)]
    assert [layout.cell(*position) for position in positions] == list(range(layout.n_cells))
    assert positions == sorted(positions)
    for outside in (-1, layout.n_cells):
        with pytest.raises(IndexError):
            layout.position(outside)


@given(layouts())
def test_a_layout_comes_back_from_json_equal_with_equal_hash(layout: SensorLayout):
    again = SensorLayout.from_dict(json.loads(json.dumps(layout.to_dict(), allow_nan=False)))
    assert (again, hash(again)) == (layout, hash(layout))


@given(layouts())
def test_each_present_cell_is_on_one_row_and_one_column_and_no_absent_position_is_on_a_line(
    layout: SensorLayout,
):
    for kind in ("row", "column"):
        served = np.concatenate(
            [layout.cells_on(line) for line in layout.lines if line.kind == kind]
        )
        assert sorted(served.tolist()) == np.flatnonzero(layout.present).tolist()
    for line in layout.lines:
        assert layout.present.ravel()[layout.cells_on(line)].all()


@given(layouts())
def test_a_stuck_address_bit_misreads_present_cells_only_and_reads_present_cells_or_none(
    layout: SensorLayout,
):
    present = layout.present.ravel()
    for line in layout.lines:
        if line.kind not in ("row_address", "column_address"):
            continue
        for level in (0, 1):
            cells, sources = layout.misaddressed(line, level)
            assert present[cells].all()
            assert present[sources[sources >= 0]].all()
            assert not np.isin(sources, cells).any()  # what is read instead is read rightly


# Fault sets


@given(fault_sets(), fault_sets(), fault_sets())
def test_fault_sets_obey_the_algebra_of_sets(a: FaultSet, b: FaultSet, c: FaultSet):
    everything = FaultSet(range(12), 12)
    assert a | b == b | a == FaultSet(tuple({*a, *b}), 12)
    assert a & b == b & a
    assert (a | b) & c == (a & c) | (b & c)
    assert everything - (a | b) == (everything - a) & (everything - b)
    assert a - b == a & (everything - b)
    assert (a & b <= a <= a | b) and a.isdisjoint(b - a)  # noqa: PT018
    assert len(a | b) + len(a & b) == len(a) + len(b)


@given(fault_sets())
def test_mask_and_healthy_cells_are_the_two_halves_of_an_array(f: FaultSet):
    assert f.mask.shape == (f.n_cells,)
    assert np.flatnonzero(f.mask).tolist() == list(f) == sorted(f)
    assert sorted([*f, *f.healthy.tolist()]) == list(range(f.n_cells))
    assert all(cell in f for cell in f)
    assert not any(cell in f for cell in f.healthy)
    assert f == set(f)
    assert hash(f) == hash(FaultSet(tuple(reversed(f.cells)), f.n_cells))


@given(fault_sets(), st.integers(13, 20))
def test_fault_sets_of_arrays_of_two_sizes_are_never_combined(f: FaultSet, n_cells: int):
    for combine in (f.__or__, f.__and__, f.__sub__):
        with pytest.raises(ValueError, match="cannot be combined"):
            combine(FaultSet((0,), n_cells))


@given(st.data(), layouts())
def test_a_fault_comes_back_from_json(data: st.DataObject, layout: SensorLayout):
    line = data.draw(st.sampled_from([line for line in layout.lines if len(layout.cells_on(line))]))
    fault = Fault(
        data.draw(st.sampled_from(FaultKind)),
        tuple(layout.cells_on(line).tolist()),
        line=data.draw(st.sampled_from([None, line])),
        value=data.draw(st.none() | FINITE),
        onset=data.draw(st.none() | st.integers(0, 10**9)),
        probability=data.draw(st.none() | st.floats(0, 1)),
        reason=data.draw(WORDS),
        evidence=data.draw(st.none() | st.integers(0, 99)),
        alternatives=tuple(data.draw(st.lists(WORDS, max_size=2))),
    )
    assert Fault.from_dict(json.loads(json.dumps(fault.to_dict(), allow_nan=False))) == fault


@given(st.data(), layouts())
def test_a_broken_wire_changes_its_own_cells_only_and_no_reading_leaves_the_range(
    data: st.DataObject, layout: SensorLayout
):
    choice = [
        line
        for line in layout.lines
        if line.kind in ("row", "column") and len(layout.cells_on(line))
    ]
    fault = line_fault(
        layout, data.draw(st.sampled_from(choice)), data.draw(st.sampled_from(["open", "short"]))
    )
    elements = st.floats(0, layout.full_scale)
    frames = (
        data.draw(npst.arrays(float, (3, layout.n_cells), elements=elements))
        * layout.present.ravel()
    )
    broken = inject(frames, [fault], layout, seed=0)
    others = np.setdiff1d(np.arange(layout.n_cells), fault.cells)
    np.testing.assert_array_equal(broken[:, others], frames[:, others])
    assert set(fault.cells) <= set(layout.cells_on(fault.line).tolist())
    np.testing.assert_array_equal(
        broken[:, fault.cells], 0 if fault.kind == "open" else layout.full_scale
    )


# Packets

DEVICES = st.text("aZ09._:-", min_size=1, max_size=64).filter(DEVICE.fullmatch)
VALUES = st.lists(st.floats(-1e30, 1e30) | st.just(math.nan), min_size=1, max_size=6)


@given(DEVICES, st.integers(0, 10**15), VALUES)
def test_a_packet_comes_back_to_six_digits(device: str, ticks: int, values: list[float]):
    packet = parse_packet(format_packet(device, ticks / 1000, values), len(values))
    assert packet.device == device
    assert packet.time == pytest.approx(ticks / 1000)
    np.testing.assert_allclose(packet.values, values, rtol=5e-6)


@given(
    st.binary(max_size=200) | st.text("ab1,.-_einfNA \n\0", max_size=60).map(str.encode),
    st.integers(1, 6),
)
def test_bytes_that_are_no_packet_raise_nothing_but_a_packet_error_of_one_line(
    data: bytes, n_cells: int
):
    try:
        packet = parse_packet(data, n_cells)
        refusal = ""
    except PacketError as error:
        packet = None
        refusal = str(error)
    assert "\n" not in refusal
    if packet:
        assert packet.values.shape == (n_cells,)
        assert not np.isinf(packet.values).any()


@given(DEVICES, VALUES, st.integers(0, 10**6), st.integers(0, 255))
def test_a_damaged_packet_raises_nothing_but_a_packet_error(
    device: str, values: list[float], place: int, byte: int
):
    data = bytearray(format_packet(device, 12.5, values))
    data[place % len(data)] = byte
    for damaged in (bytes(data), bytes(data[: place % len(data)])):
        try:
            packet = parse_packet(damaged, len(values))
        except PacketError:
            continue
        assert packet.values.shape == (len(values),)
        assert not np.isinf(packet.values).any()


# Recordings


def same(a: Recordings, b: Recordings) -> bool:
    return len(a) == len(b) and all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b, strict=True)
    )


@given(recordings())
def test_recordings_come_back_from_an_archive(written: Recordings):
    with TemporaryDirectory() as folder:
        save_npz(Path(folder) / "a.npz", written)
        read = load(Path(folder) / "a.npz").recordings
    assert same(read, written)
    assert read.layout == written.layout
    assert read.names == written.names
    assert read.class_names == written.class_names
    np.testing.assert_array_equal(read.labels, written.labels)


@given(recordings())
def test_recordings_come_back_from_text_and_from_single_arrays(written: Recordings):
    with TemporaryDirectory() as folder:
        for i, frames in enumerate(written):
            # 9 digits name a float32 exactly.
            np.savetxt(Path(folder) / f"t{i}.csv", frames, delimiter=",", fmt="%.9g")
            np.save(Path(folder) / f"a{i}.npy", frames.reshape(-1, *written.layout.shape))
        for kind in ("t*.csv", "a*.npy"):
            assert same(
                load(sorted(Path(folder).glob(kind)), layout=written.layout).recordings, written
            ), kind


@given(recordings(), st.integers(0, 10**6), st.integers(0, 7))
def test_a_damaged_archive_raises_nothing_but_an_input_error_of_one_line(
    written: Recordings, place: int, bit: int
):
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        save_npz(path, written)
        data = bytearray(path.read_bytes())
        data[place % len(data)] ^= 1 << bit
        for damaged in (bytes(data), bytes(data[: place % len(data)])):
            path.write_bytes(damaged)
            refusal = ""
            try:
                load(path)
            except InputError as error:
                refusal = str(error)
            assert "\n" not in refusal


# Documents of a bundle

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | FINITE | WORDS,
    lambda values: st.lists(values, max_size=3) | st.dictionaries(WORDS, values, max_size=3),
    max_leaves=8,
)
DOCUMENTS = st.dictionaries(
    WORDS.filter(lambda key: key not in ("sha256", "schema")), JSON, max_size=4
)


@given(DOCUMENTS)
def test_a_sealed_document_comes_back_and_another_schema_is_refused(document: dict):
    document = {"schema": SCHEMA, **document}
    with TemporaryDirectory() as folder:
        write_checksummed(Path(folder) / "a.json", document)
        assert read_checksummed(Path(folder) / "a.json", SCHEMA) == document
        with pytest.raises(Damaged, match="expected 'other/1'"):
            read_checksummed(Path(folder) / "a.json", "other/1")


@given(DOCUMENTS, st.integers(0, 10**6), st.integers(0, 7), st.booleans())
def test_no_flipped_bit_and_no_cut_passes_and_the_copy_mends_it(
    document: dict, place: int, bit: int, cut: bool
):
    document = {"schema": SCHEMA, **document}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.json"
        write_with_copy(path, document)
        assert damage(path, SCHEMA, repair=False) == []
        data = bytearray(path.read_bytes())
        place %= len(data)
        data[place] ^= 1 << bit
        path.write_bytes(data[:place] if cut else data)
        with pytest.raises(Damaged):
            read_checksummed(path, SCHEMA)
        assert read_with_copy(path, SCHEMA) == document
        assert len(damage(path, SCHEMA, repair=True)) == 1
        assert read_checksummed(path, SCHEMA) == document


NUMBERS = st.integers(1, 99)


@given(
    st.builds(
        Pointer,
        NUMBERS,
        st.lists(NUMBERS, max_size=3).map(tuple),
        st.booleans(),
        st.integers(0, 3),
        WORDS,
        st.lists(st.lists(st.integers(0, 219), max_size=4).map(tuple), max_size=3).map(tuple),
    )
)
def test_a_pointer_comes_back_from_disk_and_falls_back_to_what_was_confirmed(pointer: Pointer):
    with TemporaryDirectory() as folder:
        pointer.write(Path(folder))
        assert Pointer.read(Path(folder)) == pointer
    new = pointer.deployed(100)
    assert (new.active, new.probation, new.rejected) == (100, True, pointer.rejected)
    if new.fallbacks:
        assert new.fallen_back((1, 2)).active == (
            pointer.fallbacks[0] if pointer.probation else pointer.active
        )


@given(st.lists(DOCUMENTS, max_size=3), st.sets(WORDS, max_size=4))
def test_a_journal_returns_its_runs_in_order_and_the_recordings_that_they_saw(
    documents: list[dict], digests: set[str]
):
    with TemporaryDirectory() as folder:
        journal = Journal(Path(folder))
        for i, document in enumerate(documents):
            journal.add(
                Entry(f"t{i}", "deployed", document, [(digest, "a.npz") for digest in digests])
            )
        added = [
            {**d, "id": i + 1, "time": f"t{i}", "what": "deployed"} for i, d in enumerate(documents)
        ]
        assert Journal(Path(folder)).runs() == added
        assert journal.seen([*digests, "never seen"]) == (digests if documents else set())
        assert journal.damage(repair=False) == []
