"""Reads a bag file that was cut off or damaged: every message before the damage, and some after
it."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.data.recordings.formats.bag_fields import Found, Topic

if TYPE_CHECKING:
    import sqlite3

_MOST = 1 << 30  # bytes of one record or chunk; more is damage, and would fill the memory
_CHUNK = 0x06  # MCAP's opcode


class Salvage:
    """The messages that can still be read, in the order they were written; may be iterated more
    than once.

    Attributes:
        reason: after an iteration: where reading ended and why; empty if nothing was missing.
        skipped: chunks that were damaged and left out.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.reason = ""
        self.skipped = 0

    def __iter__(self) -> Iterator[Found]:
        self.reason = ""
        self.skipped = 0
        return self._mcap() if self.path.suffix.lower() == ".mcap" else self._sqlite()

    def _mcap(self) -> Iterator[Found]:
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader, breakup_chunk

        schemas: dict[int, Any] = {}
        channels: dict[int, Topic] = {}
        with open(self.path, "rb") as file:
            records = StreamReader(file, emit_chunks=True, record_size_limit=_MOST).records
            place = 8  # behind the magic number
            while True:
                try:
                    record = next(records)
                    place = file.tell()
                    inner = [record]
                    if isinstance(record, Chunk):
                        inner = _checked(record, breakup_chunk)
                        self.skipped += not inner
                except StopIteration:
                    return
                # cut or damaged files raise any of a dozen kinds: mcap's, struct's, zlib's
                except Exception as error:
                    self.reason = f"byte {place}: {type(error).__name__}"
                    inner = _rest(file, place)
                for one in inner:
                    if isinstance(one, Schema):
                        schemas[one.id] = one
                    elif isinstance(one, Channel):
                        channels[one.id] = _topic(one, schemas.get(one.schema_id))
                    elif isinstance(one, Message) and one.channel_id in channels:
                        yield channels[one.channel_id], int(one.log_time), bytes(one.data)
                if self.reason:
                    return

    def _sqlite(self) -> Iterator[Found]:
        import sqlite3  # slow to import, and rarely needed

        try:
            with closing(
                sqlite3.connect(f"{self.path.resolve().as_uri()}?immutable=1", uri=True)
            ) as base:
                # else SQLite refuses a file shorter than its header says
                base.execute("PRAGMA writable_schema=ON")
                topics = _sqlite_topics(base)
                before = 0
                for row in base.execute(
                    "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
                ):
                    match row:
                        case [int(number), int(topic), int(time), bytes(data)] if topic in topics:
                            if before and number != before + 1:  # the pages between were cut off
                                self.reason = f"message {before + 1} is missing"
                                return
                            before = number
                            yield topics[topic], time, data
        except sqlite3.Error as error:
            self.reason = str(error)


def _topic(channel: Any, schema: Any) -> Topic:
    definition = "" if schema is None else schema.data.decode("utf-8", "replace")
    msgtype = "" if schema is None else schema.name
    return Topic(channel.topic, msgtype, definition, channel.message_encoding)


def _checked(chunk: Any, breakup: Any) -> list[Any]:
    """Return the records of a chunk; none if it is damaged: the next chunk may be whole.

    ``Salvage.skipped`` counts the chunks without a record, and the reader tells the user their
    number.
    """
    if chunk.uncompressed_size > _MOST:
        return []
    try:
        return list(breakup(chunk, validate_crc=True))
    except Exception:  # as above, and those of the decompressors
        return []


def _rest(file: Any, place: int) -> list[Any]:
    """Return the records of a chunk that the file ends in; ``Salvage.reason`` says already where
    the file ends."""
    from mcap.stream_reader import StreamReader

    file.seek(place)
    data = file.read(_MOST)
    if len(data) < 9 or data[0] != _CHUNK:
        return []
    records = []
    try:
        # opcode, length, start, end, uncompressed size, checksum, then the compression's name
        (name,) = struct.unpack_from("<I", data, 9 + 28)
        start = 9 + 32 + name
        compression = data[9 + 32 : start].decode()
        for record in StreamReader(
            io.BytesIO(_decompressed(data[start + 8 :], compression)), skip_magic=True
        ).records:
            records.append(record)
    except Exception:  # it ends in the middle of a record: that is what is expected
        pass
    return records


def _decompressed(data: bytes, compression: str) -> bytes:
    """Return as much as the beginning of compressed data gives."""
    if compression == "zstd":
        import zstandard

        return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(data))
    if compression == "lz4":
        import lz4.frame

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data))
    return data


def _sqlite_topics(base: sqlite3.Connection) -> dict[int, Topic]:
    tables = {
        name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
    }
    definitions: dict[str, str] = {}
    if "message_definitions" in tables:
        definitions = dict(
            base.execute("SELECT topic_type, encoded_message_definition FROM message_definitions")
        )
    rows = base.execute("SELECT id, name, type FROM topics").fetchall()
    return {number: Topic(name, kind, definitions.get(kind, "")) for number, name, kind in rows}
