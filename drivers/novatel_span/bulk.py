"""A stretch of bytes to one numpy array per log, without a Python object per message."""

from __future__ import annotations

import re
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
    pattern = re.compile(rb"\xaa\x44[\x12\x13]." + re.escape(message.to_bytes(2, "little")), re.DOTALL)
    starts = np.array([found.start() for found in pattern.finditer(data)], np.intp)
    raw = np.frombuffer(data, np.uint8)
    starts = starts[starts <= len(raw) - SHORT_HEADER_BYTES - CRC_BYTES]
    short = raw[starts + 2] == 0x13
    length = np.where(short, raw[starts + 3], raw[starts + 8] + 256 * raw[starts + 9].astype(np.intp))
    headers = np.where(short, SHORT_HEADER_BYTES, raw[starts + 3]).astype(np.intp)
    ends = starts + headers + length + CRC_BYTES
    keep = (ends <= len(raw)) & (length >= body_bytes) & (ends - starts <= MAX_FRAME_BYTES)
    keep &= short | ((headers >= LONG_HEADER_BYTES) & (raw[starts + 6] & RESPONSE_BIT == 0))
    spans = zip(starts[keep].tolist(), ends[keep].tolist(), strict=True)
    keep[keep] = [zlib.crc32(data[start:end], _ONES) == _ONES for start, end in spans]
    return starts[keep], headers[keep], short[keep]
