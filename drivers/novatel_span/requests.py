"""What a receiver is, to the logs that are asked of it, and whether its line can carry them."""

from __future__ import annotations

import re
from collections.abc import Iterable

from polecal.drivers.novatel_span.enums import Component, MessageId
from polecal.drivers.novatel_span.logs import Version
from polecal.drivers.port import BITS_PER_BYTE

PERIODS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.5)
"""ONTIME periods below 1 s that a receiver takes; above, whole seconds (sheet section 5)."""

FRAME_BYTES = {
    MessageId.INSPVAS: 104,
    MessageId.INSPVAX: 158,
    MessageId.INSSTDEVS: 68,
    MessageId.INSCOVS: 244,
    MessageId.BESTPOS: 104,
    MessageId.BESTGPSPOS: 104,
    MessageId.TIME: 76,
}
"""What a log takes on the line (sheet section 5)."""

POSES = (MessageId.INSPVAS, MessageId.INSPVAX)
"""The pose logs, in the order in which they are asked for."""

FIXES = (MessageId.BESTPOS, MessageId.BESTGPSPOS)
"""Logs once a second that tell position type and time status; the second where the first is refused."""

QUALITIES = (MessageId.INSPVAX, MessageId.INSSTDEVS, MessageId.INSCOVS)
"""Logs once a second that tell the standard deviations that INSPVAS lacks; the first that is not refused."""

SLOW = (MessageId.BESTPOS, MessageId.TIME, MessageId.INSPVAX)
"""What comes once a second beside INSPVAS; INSPVAX as the poses' own log needs no third."""

USABLE = 0.95
"""How much of the line the logs may fill."""

_LACKS = {
    "4": frozenset({MessageId.INSPVAX, MessageId.INSSTDEVS, MessageId.INSCONFIG}),
    "V": frozenset({MessageId.INSPVAX, MessageId.INSSTDEVS, MessageId.INSCONFIG}),
    "6": frozenset({MessageId.INSSTDEVS, MessageId.BESTGPSPOS}),
    "7": frozenset({MessageId.BESTGPSPOS}),
}
"""By generation what there is no use in asking for (sheet section 2; INSSTDEV is OEM7's only)."""


def generation(version: Version | None) -> str:
    """Return "4", "V", "6" or "7" for OEM4 to OEM7, as VERSION says; "" where it does not tell."""
    for part in version.components if version else ():
        if part.component == Component.GPSCARD and (found := re.match(r"OEM([4V67])", part.hardware)):
            return found[1]
    return ""


def worth_asking(messages: Iterable[MessageId], of: str) -> list[MessageId]:
    """Leave out the logs that a generation is known to lack."""
    return [message for message in messages if message not in _LACKS.get(of, frozenset())]


def slow_logs(pose: MessageId) -> tuple[MessageId, ...]:
    """Return what comes once a second beside a pose log."""
    return tuple(message for message in SLOW if message != pose)


def refusal(pose: MessageId, rate_hz: float, baud: int, slow: Iterable[MessageId]) -> str:
    """Return why a line cannot carry poses at a rate and the slow logs, with the arithmetic; "" if it can."""
    sizes = [FRAME_BYTES[message] for message in slow]
    bits_per_s = (FRAME_BYTES[pose] * rate_hz + sum(sizes)) * BITS_PER_BYTE
    if bits_per_s <= USABLE * baud:
        return ""
    return (
        f"{pose.name}B at {rate_hz:g} Hz does not fit {baud} bit/s: "
        f"({FRAME_BYTES[pose]} B x {rate_hz:g} + {' + '.join(map(str, sizes))} B) x {BITS_PER_BYTE} bits = "
        f"{bits_per_s:.0f} bit/s, {bits_per_s / baud:.0%} of the line (at most {USABLE:.0%})"
    )
