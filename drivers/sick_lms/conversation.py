"""A request on the laser's line to its reply, through lost bytes and whatever else the laser is saying."""

from __future__ import annotations

import contextlib
import time
from typing import TypeVar

from polecal.drivers.errors import DeviceProtocolError
from polecal.drivers.port import Port
from polecal.drivers.sick_lms.framer import Frame, Framer, Skip
from polecal.drivers.sick_lms.telegrams import Refused, Reply, Telegram

# Times of the sheet, sections 1 and 7
ACK_S = 0.3  # 60 ms; up to 80 ms were seen, and USB adapters add theirs
REPLY_S = 1.0  # up to 130 ms at 38400 bit/s, 300 ms at 9600
MODE_S = 3.0
EEPROM_S = 15.0
_AFTER_NAK_S = 0.03
QUIET_S = 0.1  # the laser pauses for up to 14 ms within a telegram
_LATE_S = 0.25  # a reply to a request that was sent twice may come twice
_TRIES = 5
_HEARD_BYTES = 512

R = TypeVar("R", bound=Reply)


class NoReply(DeviceProtocolError):
    """The laser did not answer, however often it was asked."""


class NotAllowed(DeviceProtocolError):
    """The laser understood and refused (92h)."""


class Conversation:
    """Asks one thing at a time, so that no reply can be taken for another's.

    ``heard`` is the last of what came at the present rate, ``framer`` what cuts it.
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self._unanswered: tuple[Telegram, int, float, float] | None = None
        self._begin()

    def _begin(self) -> None:
        self.framer = Framer(self._skipped)
        self.heard = b""
        self._acked = self._refused_crc = self._garbled = self._quiet = False

    def set_baud(self, baud: int) -> None:
        """Go on at another rate of the host. Raises DeviceError."""
        self.port.set_baud(baud)
        self._begin()

    def ask(
        self,
        request: Telegram,
        reply: type[R],
        *,
        tries: int = _TRIES,
        ack_s: float = ACK_S,
        within_s: float = REPLY_S,
    ) -> R:
        """Send ``request`` until ``reply`` comes, and return it; other telegrams are passed over.

        It is sent again after ``ack_s`` without an ACK, after ``within_s`` from an ACK without the reply or
        sooner if that came broken, and after a NAK. Raises NoReply, NotAllowed, Stopped, DeviceLost.
        """
        for attempt in range(tries):
            self._send(request)
            self._unanswered = request, reply.code, ack_s, within_s
            frame = self._await(*self._unanswered)
            self._unanswered = None
            if frame is not None:
                if attempt:
                    self.pause(_LATE_S)
                return reply.parse(frame)
        raise NoReply(
            f"{self.port.path}: the laser does not answer {request.code:02X}h at {self.port.baud} bit/s",
            "check plugs and cable; if the line is good, switch the laser off and on",
        )

    def finish(self) -> None:
        """Wait for the answer to what had been asked when the stop came: it looks like the next one's.

        A0 does not say which 20h it answers. Raises Stopped, DeviceLost.
        """
        if self._unanswered is not None:
            with contextlib.suppress(NotAllowed):
                self._await(*self._unanswered)
            self._unanswered = None

    def pause(self, seconds: float) -> None:
        """Let time pass and the line run on. Raises Stopped, DeviceLost."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self._hear(left_s)

    def _send(self, request: Telegram) -> None:
        self.framer.close()  # a telegram that is under way is cut off by the request
        self._acked = self._refused_crc = self._garbled = False
        self.port.write(request.build())

    def _await(self, request: Telegram, code: int, ack_s: float, within_s: float) -> Frame | None:
        end_s = time.monotonic() + ack_s
        acked = False
        while (left_s := end_s - time.monotonic()) > 0:
            frames = self._hear(min(left_s, QUIET_S))
            for frame in frames:
                if frame.command == code:
                    return frame
                if frame.command == Refused.code:
                    self._unanswered = None
                    raise NotAllowed(
                        f"{self.port.path}: the laser says that {request.code:02X}h is not allowed now (92)",
                        "it is in another mode, or of a type that lacks this: switch it off and on, "
                        "then compare its type with the configuration",
                    )
            if self._garbled and (self._quiet or frames):  # what came broken was the answer
                return None
            if self._refused_crc and not self._acked:
                self.pause(_AFTER_NAK_S)
                return None
            if self._acked and not acked:
                acked = True
                end_s = time.monotonic() + within_s
        return None

    def _hear(self, timeout_s: float) -> list[Frame]:
        chunk = self.port.read(timeout_s)
        self._quiet = chunk is None
        if chunk is None:
            return self.framer.close() if timeout_s >= QUIET_S else []
        self.heard = (self.heard + chunk.data)[-_HEARD_BYTES:]
        return self.framer.feed(chunk.data, chunk.t_ns)

    def _skipped(self, skip: Skip) -> None:
        self._garbled |= self._acked and skip.reason not in ("ack", "nak")
        self._acked |= skip.reason == "ack"
        self._refused_crc |= skip.reason == "nak"
