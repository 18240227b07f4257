#!/bin/sh
# Guess: two readers of ROS 2 bags agree on which of the two 8-bit types without a number in their
#   name has a sign.
# Reality: they disagree on both, and each is wrong once. In a .msg file of ROS 2, `byte` is an
#   octet and `char` an unsigned number, both 0 to 255. rosbags reads byte as signed and char as
#   unsigned, mcap-ros2-support the other way round. A pressure of 200 that a driver sends in a
#   std_msgs/ByteMultiArray is -56 in one program and 200 in the other; no error, no warning.
#   Writing shows it: rosbags refuses the byte 200.
# Packages: rosbags==0.11.9, mcap==1.6.0, mcap-ros2-support==0.6.0
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet rosbags==0.11.9 mcap==1.6.0 mcap-ros2-support==0.6.0
cd "$work"
"$work/venv/bin/python" - <<'PY'
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

for name in ("rosbags", "mcap", "mcap-ros2-support"):
    print(name, version(name))
store = get_typestore(Stores.ROS2_JAZZY)
store.register(get_types_from_msg("byte[] bytes\nchar[] chars", "touch/msg/Pad"))
Pad = store.types["touch/msg/Pad"]
STORED = 200  # one octet, 0xc8, in either array
signed = np.array([STORED], np.uint8).view(np.int8)
message = Pad(signed, np.array([STORED], np.uint8))
with Writer("bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    pad = writer.add_connection("/pad", Pad.__msgtype__, typestore=store)
    data = store.serialize_cdr(message, Pad.__msgtype__)
    writer.write(pad, 1, data)
assert bytes(data).count(b"\xc8") == 2

with Reader("bag") as reader:
    for connection, _, raw in reader.messages():
        read = store.deserialize_cdr(raw, connection.msgtype)
        by_rosbags = (int(read.bytes[0]), int(read.chars[0]))
(file,) = Path("bag").glob("*.mcap")
with file.open("rb") as stream:
    decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    for _, _, _, read in decoded:
        by_mcap = (int(read.bytes[0]), int(read.chars[0]))
print("the octet 200 as (byte, char): rosbags", by_rosbags, "mcap-ros2-support", by_mcap)
if (by_rosbags, by_mcap) != ((-56, 200), (200, -56)):
    sys.exit("changed: expected (-56, 200) and (200, -56)")
PY
