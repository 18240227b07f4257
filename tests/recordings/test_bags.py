"""ROS 2 bags: whole ones, cut off ones, and what the user is told."""

import json
import re
import struct
import sys

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import InputError, load
from diagnostics import SensorLayout

rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

STORAGES = ("MCAP", "SQLITE3")
MULTI = "std_msgs/msg/Float32MultiArray"
STATE = "tactile_msgs/msg/TactileState"
rng = np.random.default_rng(0)


def newtons(frames=50, cells=220):
    return rng.uniform(0, 4.9, (frames, cells)).astype(np.float32)


def types():
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    text = "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors\nuint16[3] status\n"
    store.register(typesys.get_types_from_msg(text, STATE))
    raw = "uint16[] left\nuint16[] right\n"
    store.register(typesys.get_types_from_msg(raw, "glove_msgs/msg/TactileRaw"))
    return store


def multi_array(store, values, kind=MULTI, sizes=()):
    known = store.types
    dims = [
        known["std_msgs/msg/MultiArrayDimension"](label=str(i), size=n, stride=0)
        for i, n in enumerate(sizes)
    ]
    return known[kind](
        layout=known["std_msgs/msg/MultiArrayLayout"](dim=dims, data_offset=0), data=values
    )


def tactile_state(store, values):
    known = store.types
    stamp = known["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    channels = [
        known["sensor_msgs/msg/ChannelFloat32"](name=f"pad{i}", values=part)
        for i, part in enumerate(np.split(values, 2))
    ]
    header = known["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return known[STATE](header=header, sensors=channels, status=np.zeros(3, np.uint16))


def write_bag(path, topics, *, storage="MCAP", rate=10.0, pauses=(), compressed=None):
    """Write a bag; ``topics``: name -> (type, messages)."""
    store = types()
    with_pause = rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin[storage])
    if compressed:
        with_pause.set_compression(
            rosbag2.CompressionMode[compressed], rosbag2.CompressionFormat.ZSTD
        )
    with with_pause as writer:
        for name, (kind, messages) in topics.items():
            connection = writer.add_connection(name, kind, typestore=store)
            at = 1_700_000_000 * 10**9
            for i, message in enumerate(messages):
                at += round(1e9 / rate) + (5 * 10**9 if i in pauses else 0)
                writer.write(connection, at, store.serialize_cdr(message, kind))
    return path


def tactile(values, **options):
    store = types()
    return {"/tactile": (MULTI, [multi_array(store, frame, **options) for frame in values])}


def refusal(path, **options):
    with pytest.raises(InputError) as caught:
        load(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("whole", [True, False])
def test_a_bag_is_read_as_a_folder_or_as_its_file(tmp_path, storage, whole):
    values = newtons()
    bag = write_bag(tmp_path / "today", tactile(values), storage=storage, rate=20.0)
    loaded = load(bag if whole else next(bag.glob("today.*")))
    assert loaded.problems == ()
    (frames,) = loaded.recordings.frames
    np.testing.assert_array_equal(frames, values)
    assert loaded.recordings.layout == SensorLayout(2, 11, 10, rate=20.0)


@pytest.mark.parametrize(
    ("storage", "compressed"), [("MCAP", "STORAGE"), ("SQLITE3", "MESSAGE"), ("MCAP", "FILE")]
)
def test_compressed_bags_are_read(tmp_path, storage, compressed):
    values = newtons(20)
    bag = write_bag(tmp_path / "today", tactile(values), storage=storage, compressed=compressed)
    np.testing.assert_array_equal(load(bag).recordings.frames[0], values)


def test_bags_are_found_in_folders_beside_other_recordings_and_get_their_folders_as_classes(
    tmp_path,
):
    write_bag(tmp_path / "cup" / "b1", tactile(newtons(9)))
    write_bag(tmp_path / "ball" / "b2", tactile(newtons(8)))
    np.savetxt(tmp_path / "ball" / "c.csv", newtons(7), delimiter=",")
    recordings = load(tmp_path).recordings
    assert recordings.names == ("ball/b2", "ball/c.csv", "cup/b1")
    assert recordings.class_names == ("ball", "cup")
    assert [len(frames) for frames in recordings.frames] == [8, 7, 9]


def test_the_channels_of_a_tactile_state_are_put_one_after_another(tmp_path):
    values = newtons(20)
    store = types()
    bag = write_bag(
        tmp_path / "t", {"/hand": (STATE, [tactile_state(store, frame) for frame in values])}
    )
    assert "holds sensors.values, status; give --field" in refusal(bag)
    np.testing.assert_array_equal(load(bag, field="sensors.values").recordings.frames[0], values)


def test_topic_and_field_are_chosen_and_what_there_is_is_listed(tmp_path):
    store = types()
    values = newtons(12)
    counts = rng.integers(0, 4096, (12, 6)).astype(np.uint16)
    raw = [store.types["glove_msgs/msg/TactileRaw"](left=one, right=one[:3]) for one in counts]
    laser = store.types["std_msgs/msg/String"]
    topics = tactile(values) | {
        "/raw": ("glove_msgs/msg/TactileRaw", raw),
        "/log": ("std_msgs/msg/String", [laser(data="x")]),
    }
    bag = write_bag(tmp_path / "t", topics)
    assert (
        "several topics that may hold readings: /tactile (std_msgs/msg/Float32MultiArray), /raw"
        in refusal(bag)
    )
    np.testing.assert_array_equal(load(bag, topic="/tactile").recordings.frames[0], values)
    loaded = load(bag, topic="/raw", field="left", layout=(1, 2, 3)).recordings
    assert (loaded.layout.full_scale, loaded.layout.unit) == (4095, "count")
    np.testing.assert_array_equal(loaded.frames[0], counts)
    assert "topic /raw (glove_msgs/msg/TactileRaw) holds left, right; give --field" in refusal(
        bag, topic="/raw"
    )
    assert "has no array middle; it has left, right" in refusal(bag, topic="/raw", field="middle")
    assert "has no topic /gone; it has /tactile" in refusal(bag, topic="/gone")
    assert "holds no arrays of numbers; choose another" in refusal(bag, topic="/log")


def test_three_dimensions_of_a_multi_array_are_the_shape(tmp_path):
    values = newtons(10, 24)
    bag = write_bag(tmp_path / "t", tactile(values, sizes=(2, 3, 4)))
    assert load(bag).recordings.layout.shape == (2, 3, 4)


def test_pauses_part_recordings(tmp_path):
    values = newtons(30)
    frames = load(write_bag(tmp_path / "t", tactile(values), pauses=(10, 25))).recordings.frames
    assert [len(one) for one in frames] == [10, 15, 5]
    np.testing.assert_array_equal(np.concatenate(frames), values)


def test_rates_that_differ_by_the_jitter_of_measurement_are_the_same(tmp_path):
    write_bag(tmp_path / "a", tactile(newtons(20)), rate=10.0)
    write_bag(tmp_path / "b", tactile(newtons(20)), rate=10.2)
    write_bag(tmp_path / "c", tactile(newtons(20)), rate=15.0)
    loaded = load(tmp_path)
    assert len(loaded.recordings) == 2
    assert "rate 15.0 where the files before it have 10.0" in loaded.problems[0].message


def test_messages_of_another_width_are_left_out_and_counted(tmp_path):
    store = types()
    values = newtons(10)
    messages = [
        multi_array(store, frame if i != 4 else frame[:7]) for i, frame in enumerate(values)
    ]
    loaded = load(write_bag(tmp_path / "t", {"/tactile": (MULTI, messages)}))
    assert (
        "1 messages hold another number of readings than the first, 220"
        in loaded.problems[0].message
    )
    np.testing.assert_array_equal(loaded.recordings.frames[0], np.delete(values, 4, axis=0))


# What was cut off


@pytest.mark.parametrize(
    ("storage", "compressed"), [("MCAP", None), ("MCAP", "STORAGE"), ("SQLITE3", None)]
)
@pytest.mark.parametrize("as_folder", [True, False])
def test_a_bag_that_was_cut_off_gives_what_it_has_and_says_how_much(
    tmp_path, storage, compressed, as_folder
):
    values = newtons(2000)
    bag = write_bag(tmp_path / "t", tactile(values), storage=storage, compressed=compressed)
    file = next(bag.glob("t.*"))
    data = file.read_bytes()
    for share in (0.97, 0.5, 0.2):
        file.write_bytes(data[: int(share * len(data))])
        loaded = load(bag if as_folder else file)
        (frames,) = loaded.recordings.frames
        assert (share - 0.17) * 2000 < len(frames) < 2000
        np.testing.assert_array_equal(frames, values[: len(frames)])
        (problem,) = loaded.problems
        assert (
            f"{len(frames)} messages of /tactile, {(len(frames) - 1) / 10:.1f} s, could be read"
            in problem.message
        )
    file.write_bytes(data[:150])
    assert "no message can be read" in refusal(bag if as_folder else file)


def test_a_damaged_chunk_in_the_middle_costs_only_itself(tmp_path):
    values = newtons(2000)
    bag = write_bag(tmp_path / "t", tactile(values))
    file = next(bag.glob("*.mcap"))
    data = bytearray(file.read_bytes())
    # of a message's record; it follows the opcode 5
    length = struct.pack("<Q", 22 + 4 + 12 + 220 * 4)
    place = data.index(b"\x05" + length, len(data) // 2)
    data[place + 4] = 0xFF
    file.write_bytes(data)
    loaded = load(file)
    kept = np.concatenate(loaded.recordings.frames)
    assert 500 < len(kept) < 2000
    assert {tuple(frame[:5]) for frame in kept} <= {tuple(frame[:5]) for frame in values}
    assert re.search("; 1 damaged (chunk|message) left out", loaded.problems[0].message)


@pytest.mark.parametrize("storage", STORAGES)
def test_no_cut_or_flipped_bag_raises_anything_but_an_input_error(tmp_path, storage):
    bag = write_bag(tmp_path / "t", tactile(newtons(30, 6)), storage=storage)
    file = next(bag.glob("t.*"))
    data = file.read_bytes()
    for i in range(0, len(data), max(1, len(data) // 12)):
        for content in (data[:i], data[:i] + bytes([data[i] ^ 0x55]) + data[i + 1 :]):
            file.write_bytes(content)
            try:
                load(file, layout=(1, 2, 3))
            except InputError as error:
                assert str(error).startswith(str(file))  # noqa: PT017


def test_files_that_are_no_bags_and_metadata_that_is_none_are_refused(tmp_path):
    for name in ("a.mcap", "b.db3"):
        (tmp_path / name).write_bytes(b"garbage" * 100)
        assert "no message can be read" in refusal(tmp_path / name)
    bag = write_bag(tmp_path / "t", tactile(newtons(30)))
    (bag / "metadata.yaml").write_text("- [")
    assert len(load(bag).recordings.frames[0]) == 30


def test_without_rosbags_the_user_is_told_what_to_install(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "t", tactile(newtons(5)))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "pip install 'adaptfault[ros]'" in refusal(bag)


def test_a_bag_is_diagnosed_from_the_command_line(tmp_path, grasps, capsys):
    values = np.concatenate(grasps.frames[:20]).astype(np.float32)
    values.reshape(-1, 2, 11, 10)[:, 1, 5] = 5.0
    bag = write_bag(tmp_path / "today", tactile(values))
    assert main(["diagnose", str(next(bag.glob("*.mcap"))), "--json", "--topic", "/tactile"]) == 2
    reasons = [fault["reason"] for fault in json.loads(capsys.readouterr().out)["faults"]]
    assert any("pad 1, row 5 is short" in reason for reason in reasons)
