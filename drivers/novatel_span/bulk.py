"""A stretch of bytes to one numpy array per log, without a Python object per message."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
from numpy.typing import NDArray

from polecal.drivers.novatel_span.enums import MessageId
from polecal.drivers.novatel_span.fields import LOGS, layout
from polecal.drivers.novatel_span.framer import (
    CRC_BYTES,
    LONG_HEADER_BYTES,
    MAX_FRAME_BYTES,
    RESPONSE_BIT,
    SHORT_HEADER_BYTES,
)

_ONES = 0xFFFFFFFF  # zlib's CRC of a frame with its own NovAtel CRC behind it, from this start (sheet 1.4)
_SYNC = b"\xaa\x44\x12\x13"  # the third byte tells a long header from a short one (sheet 1.1)
_WEEK_MS = {True: (6, 8), False: (14, 16)}  # their offsets in a short and a long header (sheet 1.2, 1.3)


def columns(data: bytes, message: MessageId) -> NDArray[np.void]:
    """Return every CRC-valid binary frame of a log in ``data`` as a record, in order.

    The fields are the log's own (`polecal.drivers.novatel_span.logs`), after ``header_week`` and
    ``header_ms``; numbers as on the wire, enumerations as integers, matrices as (9,) float64. The records
    keep the frames' own spacing. Longer bodies of newer firmware are read as far as they are known. Raises
    ValueError for a log without a class, or whose bodies differ in length (RXSTATUS, VERSION, INSCONFIG).
    """
    if message not in LOGS or not layout(LOGS[message]).fixed:
        raise ValueError(f"{message.name} has no record of a fixed length")
    body = layout(LOGS[message]).dtype
    assert body.fields is not None
    own = list(body.fields)
    names = ["header_week", "header_ms", *own]
    formats = [np.dtype("<u2"), np.dtype("<u4"), *(body[name] for name in own)]
    starts, headers, short = _frames(data, message, body.itemsize)
    parts = [np.empty(0, {"names": names, "formats": formats})]
    order = [np.empty(0, np.intp)]
    for shape in np.unique(2 * headers + short):
        header, is_short = int(shape) // 2, bool(shape % 2)
        in_frame = np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": [*_WEEK_MS[is_short], *(header + body.fields[name][1] for name in own)],
                "itemsize": header + body.itemsize,
            }
        )
        # a record at every byte, of which only those at the frames' starts are looked at
        everywhere: NDArray[np.void] = np.ndarray(
            len(data) - in_frame.itemsize + 1, f"V{in_frame.itemsize}", buffer=data, strides=(1,)
        )
        order.append(np.flatnonzero(2 * headers + short == shape))
        parts.append(everywhere[starts[order[-1]]].view(in_frame))
    if len(parts) == 2:  # one kind of header, as ever on one line: no need to mix
        return parts[1]
    return np.concatenate(parts)[np.argsort(np.concatenate(order))]


def _frames(
    data: bytes, message: MessageId, body_bytes: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Return where frames of a log start, how long their headers are, and which are short ones."""
    raw = np.frombuffer(data, np.uint8)
    starts = np.flatnonzero(raw[: max(0, len(raw) - SHORT_HEADER_BYTES - CRC_BYTES + 1)] == _SYNC[0])
    id_low, id_high = message.to_bytes(2, "little")
    for at, allowed in ((1, _SYNC[1:2]), (4, (id_low,)), (5, (id_high,)), (2, _SYNC[2:])):
        found = raw[starts + at]
        starts = starts[np.logical_or.reduce([found == byte for byte in allowed])]
    short = raw[starts + 2] == 0x13
    length = np.where(short, raw[starts + 3], raw[starts + 8] + 256 * raw[starts + 9].astype(np.intp))
    headers = np.where(short, SHORT_HEADER_BYTES, raw[starts + 3]).astype(np.intp)
    ends = starts + headers + length + CRC_BYTES
    keep = (ends <= len(raw)) & (length >= body_bytes) & (ends - starts <= MAX_FRAME_BYTES)
    keep &= short | ((headers >= LONG_HEADER_BYTES) & (raw[starts + 6] & RESPONSE_BIT == 0))
    spans = map(slice, starts[keep].tolist(), ends[keep].tolist())
    sums = map(zlib.crc32, map(data.__getitem__, spans), itertools.repeat(_ONES))
    keep[keep] = np.fromiter(sums, np.uint32) == _ONES
    return starts[keep], headers[keep], short[keep]
