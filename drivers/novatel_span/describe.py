"""A frame as plain values, for people and scripts to read (the `decode` verb)."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

from polecal.drivers.novatel_span.framer import Frame
from polecal.drivers.novatel_span.logs import BestPos, InsPosx, InsPvax, Response, parse

Plain = dict[str, Any]


class Describer:
    """Describes frames in JSON-able values: names, SI units, degrees; enumerations by name."""

    def describe(self, frame: Frame) -> Plain:
        """Return the frame's name, encoding, header values and decoded fields.

        ``crc_ok`` is None for kinds that carry no checksum. A log without a class has its body as ``hex``
        or ``text``.
        """
        plain: Plain = {
            "name": frame.name or frame.kind.value.upper(),
            "encoding": frame.kind.value,
            "crc_ok": True if frame.kind.checked else None,
        }
        for key in ("week", "ms", "time_status", "receiver_status", "port_address"):
            if (value := getattr(frame, key)) is not None:
                plain[key] = _plain(value)
        decoded = parse(frame)
        if decoded is None:
            plain |= {"text": frame.text} if frame.text else {"hex": frame.body.hex()}
            return plain
        if isinstance(decoded, Response):
            plain["response"] = True
        plain |= _plain(decoded)
        if isinstance(decoded, InsPvax | InsPosx | BestPos):
            plain["height_ellipsoidal_m"] = _plain(decoded.height_ellipsoidal_m)
        return plain


def _plain(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.name
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON knows no such number
    return value
