"""Reads the rows of a SQLite file page by page, without its tree: what is cut off takes the tree with it, not the rows.

See https://www.sqlite.org/fileformat2.html: a leaf of a table (1.6) holds cells, a cell a record (2.1).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

Value = int | float | str | bytes | None

_LEAF = 0x0D
_INTEGERS = (0, 1, 2, 3, 4, 6, 8)  # bytes by serial type
_MOST = 1 << 26  # bytes of a row; more is damage


def rows(path: Path) -> Iterator[tuple[Value, ...]]:
    """Yield the columns of every row of every table, of whole pages only; damaged rows are passed over."""
    with open(path, "rb") as file:
        head = file.read(100)
        size = int.from_bytes(head[16:18], "big")
        size = 65536 if size == 1 else size
        if len(head) < 100 or size < 512:
            return
        usable = size - head[20]
        for number in range(1, file.seek(0, os.SEEK_END) // size + 1):
            page = _page(file, number, size)
            start = 100 if number == 1 else 0
            if page[start] != _LEAF:
                continue
            for i in range(int.from_bytes(page[start + 3 : start + 5], "big")):
                pointer = start + 8 + 2 * i
                place = int.from_bytes(page[pointer : pointer + 2], "big")
                try:
                    yield _record(_payload(file, page, place, size, usable))
                except (IndexError, ValueError):
                    continue


def _page(file: BinaryIO, number: int, size: int) -> bytes:
    file.seek((number - 1) * size)
    page = file.read(size)
    if len(page) < size:
        raise ValueError("the page was cut off")
    return page


def _payload(file: BinaryIO, page: bytes, place: int, size: int, usable: int) -> bytes:
    """Return the record of a cell, which goes on in other pages where it is long (1.6)."""
    length, place = _varint(page, place)
    _, place = _varint(page, place)  # the row's number
    if length > _MOST:
        raise ValueError("longer than any row")
    here = length
    if length > usable - 35:
        least = (usable - 12) * 32 // 255 - 23
        here = least + (length - least) % (usable - 4)
        here = here if here <= usable - 35 else least
    payload = bytearray(page[place : place + here])
    following = int.from_bytes(page[place + here : place + here + 4], "big") if here < length else 0
    while following and len(payload) < length:
        page = _page(file, following, size)
        following = int.from_bytes(page[:4], "big")
        payload += page[4 : min(usable, 4 + length - len(payload))]
    if len(payload) != length:
        raise ValueError("a part of the row is missing")
    return bytes(payload)


def _record(payload: bytes) -> tuple[Value, ...]:
    end, place = _varint(payload, 0)
    kinds = []
    while place < end:
        kind, place = _varint(payload, place)
        kinds.append(kind)
    values: list[Value] = []
    for kind in kinds:
        if kind in (8, 9):
            values.append(kind - 8)
            continue
        length = _INTEGERS[kind] if kind < 7 else 8 if kind == 7 else (kind - 12) // 2
        data = payload[place : place + length]
        if len(data) != length:
            raise ValueError("a column is missing")
        place += length
        if kind == 0 or kind == 7:  # nothing, or a decimal number: no column of a bag
            values.append(None)
        elif kind < 7:
            values.append(int.from_bytes(data, "big", signed=True))
        else:
            values.append(data if kind % 2 == 0 else data.decode("utf-8", "replace"))
    return tuple(values)


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """Return a number of 1 to 9 bytes and the place behind it."""
    value = 0
    for i in range(8):
        byte = data[place + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, place + i + 1
    return value << 8 | data[place + 8], place + 9
