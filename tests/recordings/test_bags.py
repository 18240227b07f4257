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
BYTES = "std_msgs/msg/ByteMultiArray"
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


@pytest.mark.parametrize("is_described", [True, False])
def test_bytes_have_no_sign_as_in_ros_2(tmp_path, is_described):
    """rosbags reads them with one; see findings/ros2_byte_and_char.sh."""
    values = np.arange(0, 250, 5, dtype=np.uint8).reshape(10, 5)
    store = types()
    messages = [multi_array(store, one.view(np.int8), BYTES) for one in values]
    storage = "MCAP" if is_described else "SQLITE3"  # version 8 of a .db3 has no definitions
    bag = write_bag(tmp_path / "t", {"/tactile": (BYTES, messages)}, storage=storage)
    np.testing.assert_array_equal(load(bag, shape=(1, 1, 5)).recordings.frames[0], values)


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
    assert "rate 15.0 where other files have 10.0" in loaded.problems[0].message


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


# Fields of any message


XELA = {
    "xela/msg/Taxel": "uint16 x\nuint16 y\nuint16 z\n",
    "xela/msg/Sensor": "float64 time\nxela/Taxel[] taxels\nint16[] temps\n",
    "xela/msg/Stream": "xela/Sensor[] sensors\n",
    "hand/msg/Press": "float32[6] pressure\nfloat32[6] temperature\nuint32 lost\n",
    "hand/msg/Hand": "hand/Press[] press\n",
}


def write_messages(path, kind, messages, topic="/tact"):
    store = types()
    for name, text in XELA.items():
        store.register(typesys.get_types_from_msg(text, name))
    writer = rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        for i, message in enumerate(messages(store.types)):
            writer.write(connection, 10**18 + i * 10**7, store.serialize_cdr(message, kind))
    return path


def test_single_numbers_in_lists_of_messages_are_reached_and_temperatures_are_no_readings(tmp_path):
    counts = rng.integers(0, 4096, (12, 2, 3, 3)).astype(np.uint16)

    def stream(known):
        Taxel, Sensor, Stream = (known[f"xela/msg/{n}"] for n in ("Taxel", "Sensor", "Stream"))
        for frame in counts:
            yield Stream(
                sensors=[
                    Sensor(
                        time=0.0,
                        taxels=[Taxel(*taxel.tolist()) for taxel in sensor],
                        temps=np.zeros(3, np.int16),
                    )
                    for sensor in frame
                ]
            )

    bag = write_messages(tmp_path / "xela", "xela/msg/Stream", stream)
    told = refusal(bag, topic="/tact")
    assert "sensors.taxels.x, sensors.taxels.y, sensors.taxels.z; give --field" in told
    loaded = load(bag, topic="/tact", field="sensors.taxels.z", layout="2x1x3")
    np.testing.assert_array_equal(loaded.recordings.frames[0], counts[..., 2].reshape(12, -1))
    loaded = load(bag, topic="/tact", field="sensors.taxels", layout="2x3x3")
    np.testing.assert_array_equal(loaded.recordings.frames[0], counts.reshape(12, -1))
    assert "has no array sensors.gone" in refusal(bag, topic="/tact", field="sensors.gone")


def test_of_several_arrays_that_of_touch_is_read_where_one_is_named_so(tmp_path):
    values = rng.normal(10, 1, (12, 2, 6)).astype(np.float32)

    def hands(known):
        Press, Hand = known["hand/msg/Press"], known["hand/msg/Hand"]
        hot = np.full(6, 30, np.float32)
        for frame in values:
            yield Hand(press=[Press(pressure=one, temperature=hot, lost=0) for one in frame])

    bag = write_messages(tmp_path / "hand", "hand/msg/Hand", hands)
    loaded = load(bag, topic="/tact", layout="2x2x3")
    np.testing.assert_array_equal(loaded.recordings.frames[0], values.reshape(12, -1))


@pytest.mark.parametrize("big", [False, True])
def test_fields_of_a_cloud_are_read_by_their_names_and_its_bytes_never(big, tmp_path):
    order = ">" if big else "<"
    packed = np.dtype({"names": ["x", "intensity"], "formats": [f"{order}f4"] * 2, "itemsize": 12})
    points = np.zeros((12, 3, 4), packed)
    points["intensity"] = rng.random((12, 3, 4))

    def clouds(known):
        Field = known["sensor_msgs/msg/PointField"]
        Header = known["std_msgs/msg/Header"]
        fields = [Field("x", 0, 7, 1), Field("intensity", 4, 7, 1)]
        stamp = known["builtin_interfaces/msg/Time"](0, 0)
        for frame in points:
            data = np.frombuffer(frame.tobytes(), np.uint8)
            cloud = known["sensor_msgs/msg/PointCloud2"]
            yield cloud(Header(stamp, ""), 3, 4, fields, big, 12, 48, data, True)

    bag = write_messages(tmp_path / "cloud", "sensor_msgs/msg/PointCloud2", clouds)
    loaded = load(bag, topic="/tact", field="intensity")
    assert loaded.recordings.layout.shape == (1, 3, 4)
    expected = points["intensity"].astype(np.float32).reshape(12, -1)
    np.testing.assert_array_equal(loaded.recordings.frames[0], expected)
    assert "holds x, intensity; give --field" in refusal(bag, topic="/tact", layout="3x4")
    assert "has no array data" in refusal(bag, topic="/tact", field="data", layout="12x12")


# One topic a pad


def write_pads(path, values, *, rates=(10, 10), lost=(), names=("left", "right")):
    """Write a topic a pad; ``lost``: frames of the last that did not come."""
    store = types()
    writer = rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        connections = [
            writer.add_connection(f"/tactile/{name}", MULTI, typestore=store) for name in names
        ]
        for i, frame in enumerate(values):
            for pad, connection in enumerate(connections):
                if i % (rates[0] // rates[pad]) or (pad == len(names) - 1 and i in lost):
                    continue
                message = multi_array(store, frame[pad].ravel(), sizes=frame[pad].shape)
                at = 10**18 + i * 10**8 + pad * 10**6
                writer.write(connection, at, store.serialize_cdr(message, MULTI))
    return path


@pytest.mark.parametrize(
    "topic", [None, "/tactile/left,/tactile/right", "/tactile/*", "/tactile/left"]
)
def test_topics_are_pads_as_they_are_named_and_their_dimensions_are_the_shape(topic, tmp_path):
    values = rng.random((30, 2, 3, 4)).astype(np.float32)
    bag = write_pads(tmp_path / "t", values)
    loaded = load(bag) if topic is None else load(bag, topic=topic)
    expected = values[:, :1] if topic == "/tactile/left" else values
    assert loaded.problems == ()
    assert loaded.recordings.layout.shape == expected.shape[1:]
    assert loaded.recordings.layout.rate == pytest.approx(10)
    np.testing.assert_array_equal(loaded.recordings.frames[0], expected.reshape(30, -1))


def test_a_pad_that_sends_more_slowly_keeps_its_reading_and_one_that_is_silent_is_missing(tmp_path):
    values = rng.random((40, 2, 3, 4)).astype(np.float32)
    bag = write_pads(tmp_path / "slow", values, rates=(10, 5))
    right = load(bag).recordings.frames[0].reshape(40, 2, -1)[:, 1]
    np.testing.assert_array_equal(right[::2], values[::2, 1].reshape(20, -1))
    bag = write_pads(tmp_path / "silent", values, lost=range(20, 40))
    right = load(bag).recordings.frames[0].reshape(40, 2, -1)[:, 1]
    assert np.isfinite(right[:25]).all()
    assert np.isnan(right[25:]).all()


# JSON


def write_json(path, messages, topic="/tactile"):
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("touch", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel(topic, "json", schema)
        for i, message in enumerate(messages):
            at = i * 20_000_000
            data = message if isinstance(message, bytes) else json.dumps(message).encode()
            writer.add_message(channel, log_time=at, publish_time=at, data=data)
        writer.finish()
    return path


def test_messages_of_json_are_read(tmp_path):
    values = rng.random((30, 3, 4)).round(3)
    messages = [{"stamp": i, "data": frame.tolist()} for i, frame in enumerate(values)]
    messages[4]["data"][0][0] = None
    messages[7] = b'{"data": [['
    messages[9] = {"data": [[1.0, 2.0], [3.0]]}
    loaded = load(write_json(tmp_path / "a.mcap", messages))
    assert loaded.recordings.layout.shape == (1, 3, 4)
    assert loaded.recordings.layout.rate == pytest.approx(50, rel=0.02)
    values[4, 0, 0] = np.nan
    expected = np.delete(values, [7, 9], axis=0).astype(np.float32).reshape(28, -1)
    np.testing.assert_array_equal(loaded.recordings.frames[0], expected)
    assert any("2 damaged messages left out" in problem.message for problem in loaded.problems)


def test_what_the_viewer_writes_is_read_again(tmp_path, small_grasps, capsys):
    from adaptfault.data.recordings import Recordings, save_npz

    frames = sorted(small_grasps.frames, key=np.max)[-2:]
    save_npz(tmp_path / "a.npz", Recordings(tuple(frames), small_grasps.layout))
    command = ["view", str(tmp_path / "a.npz"), "--mcap", str(tmp_path / "a.mcap"), "--quiet"]
    assert main(command) in (0, 1, 2)
    capsys.readouterr()
    assert "give --topic (topic=), as --topic /tactile/0/" in refusal(tmp_path / "a.mcap")
    again = load(tmp_path / "a.mcap", topic="/tactile/*/readings").recordings
    assert again.layout.shape == small_grasps.layout.shape
    np.testing.assert_array_equal(np.concatenate(again.frames), np.concatenate(frames))
