"""Commands to the receiver, as the line of text and the binary frame that say the same (sheet section 5)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from polecal.drivers.novatel_span.enums import MessageId, PortId, Trigger
from polecal.drivers.novatel_span.framer import LONG_HEADER_BYTES, crc32


@dataclass(frozen=True, slots=True)
class Command:
    """One command; ``binary`` is None where it is only known as text."""

    text: str
    binary: bytes | None

    @property
    def ascii(self) -> bytes:
        """The line as it is sent."""
        return self.text.encode("ascii") + b"\r\n"


def unlog_all(held: bool) -> Command:
    """Stop every log on this port; with ``held``, also those that were to survive it."""
    body = struct.pack("<II", PortId.THISPORT, held)
    return Command("UNLOGALL THISPORT" + " TRUE" * held, _binary(MessageId.UNLOGALL, body))


def log(message: MessageId, trigger: Trigger, period_s: float = 0.0) -> Command:
    """Send a log in binary on this port: ONCE, or ONTIME every ``period_s``."""
    body = struct.pack("<IHBBIddI", PortId.THISPORT, message, 0, 0, trigger, period_s, 0.0, 0)
    period = f" {period_s:g}" if trigger is Trigger.ONTIME else ""
    return Command(f"LOG {message.name}B {trigger.name}{period}", _binary(MessageId.LOG, body))


def serial_config(com: int, baud: int) -> Command:
    """Set the rate of COM port number ``com``, 8N1, no handshake, break detection off (OEM6, OEM7).

    The reply still comes at the old rate.
    """
    body = struct.pack("<7I", com, baud, 0, 8, 1, 0, 0)  # its own enumeration of ports: COM1 is 1
    return Command(f"SERIALCONFIG COM{com} {baud} N 8 1 N OFF", _binary(MessageId.SERIALCONFIG, body))


def com_config(com: int, baud: int) -> Command:
    """As `serial_config`, for OEM4 and OEMV."""
    return Command(f"COM COM{com},{baud},N,8,1,N,OFF,ON", None)


def _binary(message: MessageId, body: bytes) -> bytes:
    """Frame a command; what the receiver ignores is zero (sheet 1.2)."""
    port = PortId.THISPORT
    head = struct.pack("<3sBHBBH", b"\xaa\x44\x12", LONG_HEADER_BYTES, message, 0, port, len(body))
    frame = head.ljust(LONG_HEADER_BYTES, b"\0") + body
    return frame + struct.pack("<I", crc32(frame))
