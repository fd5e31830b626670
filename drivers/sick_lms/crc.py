"""A telegram's bytes to its CRC-16, all of them at once.

The sheet's check (section 1) shifts once a byte, feeds back 8005h and adds each byte twice: as it is, and
8 bits up one step later. That is linear over GF(2), so the CRC is the XOR of one 16-bit word per byte,
which depends only on the byte's value and on its distance from the end. All those words are one table.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_TELEGRAM_BYTES = 814  # sheet section 1: 812, and two index bytes
_POLYNOMIAL = 0x8005
_CHECKED_BYTES = MAX_TELEGRAM_BYTES - 2


def _shifted(words: NDArray[np.uint16]) -> NDArray[np.uint16]:
    carried = np.where(words & 0x8000, _POLYNOMIAL, 0)
    return (((words.astype(np.uint32) << 1) & 0xFFFF) ^ carried).astype(np.uint16)


def _table() -> NDArray[np.uint16]:
    """Row d is what each byte value adds when it stands d bytes from the end; (812, 256) uint16."""
    value: NDArray[np.uint16] = np.arange(256, dtype=np.uint16)
    rows = [value]  # the last byte is added as it is, and has no step after it
    row: NDArray[np.uint16] = (_shifted(value) ^ (value << 8)).astype(np.uint16)
    while len(rows) < _CHECKED_BYTES:
        rows.append(row)
        row = _shifted(row)
    return np.stack(rows)


_WORDS = _table().ravel()
_ROW_AT = np.arange(_CHECKED_BYTES - 1, -1, -1, dtype=np.intp) * 256


def crc16(data: bytes, start: int = 0, end: int | None = None) -> int:
    """CRC of ``data[start:end]``, which runs from STX to the last byte before the CRC; at most 812 bytes."""
    size = (len(data) if end is None else end) - start
    values = np.frombuffer(data, np.uint8, size, start)
    return int(np.bitwise_xor.reduce(_WORDS.take(_ROW_AT[_CHECKED_BYTES - size :] + values)))
