r"""The bytes of an LMS-2xx line, however they arrive, to the whole telegrams in them.

    | 02 | address | L low | L high | command, data ... (L bytes) | CRC low | CRC high |

There is no end mark, and 02 may stand anywhere in the data, so a telegram is what has a possible length
and the right CRC (sheet section 1). What the framer lives through:

- noise, a false 02 before a telegram, a telegram with wrong bytes: the 02 is dropped and the search goes
  on at the next byte, so nothing behind it is lost;
- a telegram cut off by a reply: a laser that streams stops in the middle of a B0 to answer,
  ``02 80 28 03 B0 ... 06 02 80 03 00 A0 00 10 16 0A``. A whole telegram right behind an ACK is taken
  even within the bytes that the one before it announced, and without waiting for the rest of those.

Each decision depends on the bytes alone, never on how they were split.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

from polecal.drivers.sick_lms.crc import MAX_TELEGRAM_BYTES, crc16

STX = 0x02
ACK = 0x06
NAK = 0x15
REPLY = 0x80  # added to the address, and to the command, of what the laser sends
_AROUND = 6  # bytes of a telegram that its length does not count: STX, address, length, CRC
_ACK_STX = bytes((ACK, STX))

Reason = Literal["ack", "nak", "noise", "crc", "length", "cut off"]


@dataclass(frozen=True, slots=True)
class Frame:
    """One telegram with the right CRC.

    ``t_first_ns`` and ``t_last_ns`` are the stamps of the chunks that held its first and last byte;
    ``lead_bytes`` is how many bytes of that first chunk came at or after its first byte.
    """

    offset: int
    data: bytes
    t_first_ns: int
    t_last_ns: int
    lead_bytes: int

    @property
    def address(self) -> int:
        """The laser's address, with 80h added in a reply."""
        return self.data[1]

    @property
    def command(self) -> int:
        """The command code, or the reply code."""
        return self.data[4]

    @property
    def body(self) -> bytes:
        """From the command byte to the last data byte, in a reply the status byte."""
        return self.data[4:-2]


@dataclass(frozen=True, slots=True)
class Skip:
    """Bytes that belong to no telegram, and why."""

    offset: int
    data: bytes
    reason: Reason


class Framer:
    """Cuts the telegrams of either side out of a stream; holds at most one telegram's bytes back.

    ``on_skip`` takes, in order, all that is no telegram: each ACK and NAK beside a telegram by itself;
    the first byte of each bad frame, with what was wrong with it; and noise. ``bad_frames`` counts what
    began like a telegram and failed, once for all that lay within its announced length.
    """

    def __init__(self, on_skip: Callable[[Skip], None] | None = None) -> None:
        self.frames = 0
        self.bad_frames = 0
        self._on_skip = on_skip
        self._held = b""
        self._start = 0  # offset of the first held byte in the stream
        self._ends: list[int] = []  # of each chunk still held, the offset of its end,
        self._stamps: list[int] = []  # and its stamp
        self._telegram_end = 0  # of what is held, if that is nothing but the beginning of a telegram
        self._in_step = True  # nothing but whole telegrams, ACKs and NAKs so far
        self._bad_until = 0
        self._verdicts: dict[int, bool] = {}  # on what stands behind an ACK, by offset: asked many times

    @property
    def lacking(self) -> int:
        """How many bytes must come at least before there is another telegram, if none is cut off."""
        return max(1, self._telegram_end - len(self._held))

    def feed(self, data: bytes, t_ns: int) -> list[Frame]:
        """Take the next bytes of the stream, read at ``t_ns``; return the telegrams that are now whole."""
        return self.feed_all(((data, t_ns),))

    def feed_all(self, chunks: Iterable[tuple[bytes, int]]) -> list[Frame]:
        """Take the next bytes of the stream in some chunks, each with the time at which it was read."""
        at = len(self._held)
        for data, t_ns in chunks:
            if data:
                self._held += data
                self._ends.append(self._start + len(self._held))
                self._stamps.append(t_ns)
        if at == len(self._held):
            return []
        if len(self._held) < self._telegram_end and self._held.find(_ACK_STX, at - 1) < 0:
            return []  # most chunks end within a telegram
        frames = self._scan(final=False)
        self._telegram_end = self._undisturbed_end()
        return frames

    def close(self) -> list[Frame]:
        """Wait no longer for the rest of what is held: the line is silent, or the file at its end.

        Returns the telegrams that stood behind a false start. The stream may go on afterwards.
        """
        frames = self._scan(final=True)
        self._in_step, self._telegram_end = True, 0
        return frames

    def _scan(self, *, final: bool) -> list[Frame]:
        held, size = self._held, len(self._held)
        frames: list[Frame] = []
        noise = at = 0  # held[noise:at] is noise that is not handed over yet
        while at < size:
            if self._in_step and held[at] in (ACK, NAK):
                self._skip(at, at + 1, "ack" if held[at] == ACK else "nak")
                noise = at = at + 1
                continue
            if held[at] != STX:
                self._in_step = False
                at = held.find(STX, at)
                at = size if at < 0 else at
                continue
            fault, end = self._judge(at, final=final)
            if fault is None and end > size:
                break
            if fault is None:
                acked = at > noise and held[at - 1] == ACK
                self._skip(noise, at - acked, "noise")
                self._skip(at - acked, at, "ack")
                frames.append(self._frame(at, end))
                noise = at = end
                self._in_step = True
                continue
            self._in_step = False
            if self._start + at >= self._bad_until:
                self.bad_frames += 1
                self._bad_until = self._start + end
                self._skip(noise, at, "noise")
                self._skip(at, at + 1, fault)
                noise = at + 1
            at += 1
        # 06 in noise is an ACK if a telegram follows, so it waits with what follows
        kept = at - 1 if at > noise and held[at - 1] == ACK and not final else at
        self._skip(noise, kept, "noise")
        self._start += kept
        self._held = held[kept:]
        done = bisect_right(self._ends, self._start)
        del self._ends[:done], self._stamps[:done]
        return frames

    def _undisturbed_end(self) -> int:
        """Where the telegram will end that is held, 0 if what is held needs another look with each byte."""
        if len(self._held) < 4 or self._held[0] != STX or _ACK_STX in self._held:
            return 0
        return self._end(0) or 0

    def _judge(self, at: int, *, final: bool) -> tuple[Reason | None, int]:
        """Say what is wrong with the telegram that may begin at ``at``, and where it ends.

        Nothing is wrong and the end lies beyond what is held: it is not decided yet.
        """
        size = len(self._held)
        end = self._end(at)
        if end is None:
            return "length", at + _AROUND
        limit, ack = min(end, size), 0  # of those behind an ACK, the one that was whole first counts
        behind = self._held.find(_ACK_STX, at + 1, limit)
        while behind >= 0:
            whole = self._whole(behind + 1, limit)
            if whole is not None:
                limit, ack = whole - 1, behind
            behind = self._held.find(_ACK_STX, behind + 1, limit)
        if ack:
            return "cut off", ack
        if end > size:
            return ("cut off", size) if final else (None, end)
        return (None, end) if self._checked(at, end) else ("crc", end)

    def _end(self, at: int) -> int | None:
        """Where the telegram at ``at`` ends by its length field; None where no telegram is so long."""
        if at + 4 > len(self._held):
            return at + _AROUND + 1  # the shortest there is
        length = self._held[at + 2] | self._held[at + 3] << 8
        return at + _AROUND + length if 1 <= length <= MAX_TELEGRAM_BYTES - _AROUND else None

    def _whole(self, at: int, limit: int) -> int | None:
        """Where the reply at ``at`` ends, if it is right and ends by ``limit``."""
        if at + 4 > limit or not self._held[at + 1] & REPLY:
            return None
        end = self._end(at)
        if end is None or end > limit:
            return None
        offset = self._start + at
        if offset not in self._verdicts:
            if len(self._verdicts) > MAX_TELEGRAM_BYTES:
                self._verdicts.clear()
            self._verdicts[offset] = self._checked(at, end)
        return end if self._verdicts[offset] else None

    def _checked(self, at: int, end: int) -> bool:
        return crc16(self._held, at, end - 2) == self._held[end - 2] | self._held[end - 1] << 8

    def _frame(self, at: int, end: int) -> Frame:
        self.frames += 1
        offset, after = self._start + at, self._start + end
        first, last = bisect_right(self._ends, offset), bisect_right(self._ends, after - 1)
        return Frame(
            offset, self._held[at:end], self._stamps[first], self._stamps[last], self._ends[first] - offset
        )

    def _skip(self, start: int, end: int, reason: Reason) -> None:
        if start < end and self._on_skip is not None:
            self._on_skip(Skip(self._start + start, self._held[start:end], reason))
