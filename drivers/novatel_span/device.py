"""A SPAN receiver on a serial line: found at its rate, set to ours, made to log poses, left silent.

The receiver answers a command in the form in which it was given, between its logs; replies may be
switched off, and ASCII commands refused altogether (INTERFACEMODE). So each step is judged by the reply
where one comes, and by the data in any case (sheet 1.6, 5). Nothing is ever saved in the receiver.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections import deque
from collections.abc import Callable, Sequence

from polecal.drivers.device import Device
from polecal.drivers.errors import DeviceError, DeviceNotFound, DeviceProtocolError
from polecal.drivers.novatel_span.commands import Command, com_config, log, serial_config, unlog_all
from polecal.drivers.novatel_span.enums import FINE_TIME, Component, MessageId, TimeStatus, Trigger
from polecal.drivers.novatel_span.framer import Frame, Framer, Kind
from polecal.drivers.novatel_span.logs import InsConfig, Response, Version, parse
from polecal.drivers.novatel_span.nav import reference_point
from polecal.drivers.novatel_span.requests import (
    FIXES,
    PERIODS_S,
    POSES,
    QUALITIES,
    generation,
    refusal,
    slow_logs,
    worth_asking,
)
from polecal.drivers.port import Chunk, Port, Tap

RATES = (115200, 9600, 230400, 57600, 38400, 19200, 460800, 921600)
"""Rates at which a receiver is looked for after the configured one, the likely ones first, bit/s."""

_ABOUT_ITSELF = (MessageId.VERSION, MessageId.INSCONFIG)
_PORT_OF_ADDRESS = {1: "COM1", 2: "COM2", 3: "COM3"}  # a header's port address // 32 (sheet 3.6)


class NovatelSpan(Device):
    """A NovAtel SPAN receiver (OEM4 to OEM7).

    rate_hz: of the pose log, one of 1 / `PERIODS_S` or 1 / whole seconds.
    """

    kind = "novatel_span"

    answer_s = 0.7
    """How long an answer may take: a reply at 9600 bit/s takes 15 ms, the receiver's tail 170 ms."""
    patience_s = 3.0
    """How long it may take behind what a busy line has still to send."""
    quiet_s = 0.25
    """A line without a byte for so long has said everything."""

    def __init__(self, name: str, path: str, baud: int, tap: Tap, *, rate_hz: float = 100.0) -> None:
        super().__init__(name, path, baud, tap)
        self.rate_hz = rate_hz
        self.silence_s = max(Device.silence_s, 3.0 / rate_hz)
        self.pose: MessageId | None = None
        """The pose log that the receiver sends."""
        self.reference_point = reference_point(None)
        """Which point of the vehicle the poses speak of, as far as the receiver says."""
        self.results: dict[str, str] = {}
        """What the receiver answered to each command of the last set-up: OK, ERROR:..., or nothing."""
        self._talk: _Talk | None = None

    def about(self) -> dict[str, object]:
        """Give the point of the vehicle that its poses speak of."""
        return {"reference_point": self.reference_point}

    def _set_up(self, port: Port) -> None:
        period_s = self._period_s()
        self.pose, self.results, self._talk = None, {}, None
        self._talk = self._find(port)
        self._talk = self._set_rate(port, self._talk)
        try:
            self._start(port, self._talk, period_s)
        except DeviceError:  # what did start must not go on for nobody
            with contextlib.suppress(DeviceError):
                self._leave(port)
            raise

    def _start(self, port: Port, talk: _Talk, period_s: float) -> None:
        of = generation(talk.version)
        for message in worth_asking([MessageId.INSCONFIG], of):
            self._ask(talk, log(message, Trigger.ONCE))
        self.pose = self._request_pose(talk, port, period_s)
        fix = self._request_slow(talk, worth_asking(FIXES, of))
        clock = self._request_slow(talk, [MessageId.TIME])
        if self.pose is not MessageId.INSPVAX:
            beside = [message for message in (fix, clock) if message is not None]
            self._request_slow(talk, worth_asking(QUALITIES, of), self.pose, beside)
        self._await_pose(talk, self.pose, period_s)
        self._say_who(talk)

    def _heard(self, chunk: Chunk) -> bool:
        assert self._talk is not None
        frames = self._talk.take(chunk)
        if self._talk.greeted:
            raise DeviceProtocolError(
                f"{self.name} on {self.path}: the receiver has restarted",
                "check its power; it is being set up again",
            )
        return any(frame.message_id == self.pose for frame in frames)

    def _leave(self, port: Port) -> None:
        if self._talk is not None:
            self._talk.start_line()
            self._talk.ask(unlog_all(held=False), self.answer_s)

    def _period_s(self) -> float:
        period_s = 1.0 / self.rate_hz
        for known_s in (*PERIODS_S, float(max(1, round(period_s)))):
            if abs(period_s - known_s) < 1e-6:
                return known_s
        rates = ", ".join(f"{1 / p:g}" for p in PERIODS_S)
        raise DeviceError(
            f"{self.name}: a receiver cannot log at {self.rate_hz:g} Hz", f"set rate_hz to one of {rates}, 1"
        )

    def _find(self, port: Port) -> _Talk:
        heard: list[str] = []
        rates = dict.fromkeys((self.baud, *RATES))
        for binary in (False, True):  # a port in NOVATELBINARY mode hears no ASCII
            for baud in rates:
                if port.baud != baud:
                    port.set_baud(baud)
                talk = _Talk(port, binary)
                if self._probe(talk):
                    return talk
                if talk.checked:  # the rate is right, so it may listen to the other form
                    talk = _Talk(port, not binary)
                    if self._probe(talk):
                        return talk
                    raise DeviceProtocolError(
                        f"{self.name} on {port.path}: a receiver sends logs at {baud} bit/s, "
                        "but takes no command",
                        "set its port to take them, from another port: INTERFACEMODE COM1 NOVATEL NOVATEL ON",
                    )
                if not binary:
                    heard.append(f"{baud}: {talk.heard_bytes} bytes")
        raise DeviceNotFound(
            f"{self.name}: no NovAtel receiver on {port.path} (heard without a whole frame, at bit/s: "
            f"{', '.join(heard)})",
            "check its power and cable, and that this is the receiver's port and not another device's",
        )

    def _probe(self, talk: _Talk) -> bool:
        """Stop what the port sends, ask who it is, and say whether anything answers to that."""
        talk.start_line()
        talk.send(unlog_all(held=True))
        talk.send(log(MessageId.VERSION, Trigger.ONCE))
        if not talk.listen(self.answer_s, lambda: talk.answered) and talk.checked:
            talk.listen(self.patience_s, lambda: talk.answered)
        if talk.answered:
            talk.drain(self.quiet_s, self.patience_s)
        return talk.answered

    def _set_rate(self, port: Port, talk: _Talk) -> _Talk:
        """Bring receiver and host to the configured rate, or say why they stay where they are."""
        found = port.baud
        com = re.fullmatch(r"COM(\d+)", talk.port_name)
        if com is None:
            if talk.has_rate:
                self._check_line(POSES[0], found)
            if found != self.baud:
                self._log.warning(
                    "the receiver's port has no rate to set", its_port=talk.port_name, baud=found
                )
            return talk
        self._check_line(POSES[0], self.baud)
        if found == self.baud:
            return talk
        commands = [serial_config(int(com[1]), self.baud), com_config(int(com[1]), self.baud)]
        if generation(talk.version) in ("4", "V"):  # which know only the second
            commands.reverse()
        for command in commands:
            if talk.binary and command.binary is None:
                continue
            if self._ask(talk, command).startswith("ERROR"):
                continue
            port.set_baud(self.baud)
            moved = _Talk(port, talk.binary, talk.port_name)
            if any(self._probe(moved) for _ in range(3)):
                return moved
            port.set_baud(found)
            talk = _Talk(port, talk.binary, talk.port_name)
            if not any(self._probe(talk) for _ in range(3)):
                raise DeviceProtocolError(
                    f"{self.name} on {port.path}: silent at {found} and at {self.baud} bit/s "
                    f"after {command.text}",
                    "it is looked for again; if this repeats, the adapter may not do that rate: set another",
                )
        self._check_line(POSES[0], found)
        self._log.warning(
            "the receiver stays at its rate", baud=found, wanted=self.baud, answers=self.results
        )
        return talk

    def _check_line(self, pose: MessageId, baud: int) -> None:
        """Raise DeviceError, with the arithmetic, where the logs do not fit the line."""
        if reason := refusal(pose, self.rate_hz, baud, slow_logs(pose)):
            raise DeviceError(f"{self.name}: {reason}", "raise navigation.baud or lower navigation.rate_hz")

    def _request_pose(self, talk: _Talk, port: Port, period_s: float) -> MessageId:
        refused = []
        for pose in POSES:
            if talk.has_rate:
                self._check_line(pose, port.baud)
            command = log(pose, Trigger.ONTIME, period_s)
            talk.ids.clear()
            answer = self._ask(talk, command)
            if not answer.startswith("ERROR"):
                return pose
            refused.append(f"{command.text}: {answer}")
        raise DeviceProtocolError(
            f"{self.name} on {port.path}: the receiver refuses every pose log ({'; '.join(refused)})",
            "its model must include SPAN (see VERSION), and have an IMU",
        )

    def _request_slow(
        self,
        talk: _Talk,
        messages: Sequence[MessageId],
        pose: MessageId | None = None,
        beside: Sequence[MessageId] = (),
    ) -> MessageId | None:
        """Ask for the first of some logs that is not refused, once a second; none of them is needed.

        With ``pose``, only for what the line can carry beside that and the logs in ``beside``.
        """
        for message in messages:
            command = log(message, Trigger.ONTIME, 1.0)
            reason = ""
            if pose is not None and talk.has_rate:
                reason = refusal(pose, self.rate_hz, talk.port.baud, [*beside, message])
            if not reason:
                answer = self._ask(talk, command)
                if not answer.startswith("ERROR"):
                    return message
                reason = answer
            self._log.warning("a log is not sent", command=command.text, reason=reason)
        return None

    def _ask(self, talk: _Talk, command: Command) -> str:
        answer = talk.ask(command, self.patience_s if talk.replies else self.answer_s)
        self.results = {**self.results, command.text: answer}
        return answer

    def _await_pose(self, talk: _Talk, pose: MessageId, period_s: float) -> None:
        if pose in talk.ids or talk.listen(self.patience_s + 2 * period_s, lambda: pose in talk.ids):
            return
        clock = talk.time_status
        why = "" if clock is None or clock in FINE_TIME else f"; the receiver's time is {_word(clock)}"
        raise DeviceProtocolError(
            f"{self.name} on {talk.port.path}: no {pose.name}B came, though it was asked for{why}",
            "inertial logs start once the receiver has time from satellites and hears its IMU",
        )

    def _say_who(self, talk: _Talk) -> None:
        self.identity = "NovAtel receiver"
        for part in talk.version.components if talk.version else ():
            if part.component == Component.GPSCARD:
                self.identity = f"NovAtel {part.hardware}, model {part.model}, firmware {part.software}"
        self.reference_point = reference_point(talk.config)


class _Talk:
    """What was said and heard at one rate, in one form of command."""

    def __init__(self, port: Port, binary: bool, port_name: str = "") -> None:
        self.port = port
        self.binary = binary
        self.port_name = port_name
        """What the receiver calls its port, as far as it has said."""
        self.checked = False
        """Whether anything with a right checksum came."""
        self.answered = False
        """Whether anything came that only an understood command can have caused."""
        self.replies = False
        """Whether commands get replies."""
        self.heard_bytes = 0
        self.ids: set[int | None] = set()
        self.version: Version | None = None
        self.config: InsConfig | None = None
        self.time_status: TimeStatus | int | None = None
        self.greeted = False
        """Whether the last prompt followed no reply: a receiver gives one by itself when it starts."""
        self._last: Kind | None = None
        self._framer = Framer()
        self._answers: deque[str] = deque(maxlen=8)

    @property
    def has_rate(self) -> bool:
        """Whether the receiver's port is a real line, as far as is known; USB and ICOM ports are none."""
        return not self.port_name or re.fullmatch(r"COM\d+", self.port_name) is not None

    def start_line(self) -> None:
        """End whatever half a line the receiver has heard, also before a binary command."""
        self.port.write(b"\r\n")

    def send(self, command: Command) -> None:
        self.port.write(command.binary if self.binary and command.binary else command.ascii)

    def ask(self, command: Command, timeout_s: float) -> str:
        """Send a command; return "OK", "ERROR:" and the receiver's text, or "" where no reply came."""
        self._answers.clear()
        self.send(command)
        self.listen(timeout_s, lambda: bool(self._answers))
        return self._answers.popleft() if self._answers else ""

    def listen(self, timeout_s: float, enough: Callable[[], bool]) -> bool:
        """Read until what was heard is ``enough``, and return True, or for ``timeout_s``."""
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            chunk = self.port.read(left_s)
            if chunk is not None and self.take(chunk) and enough():
                return True
        return False

    def drain(self, quiet_s: float, timeout_s: float) -> None:
        """Read until nothing has come for ``quiet_s``, at most for ``timeout_s``."""
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s and (chunk := self.port.read(quiet_s)) is not None:
            self.take(chunk)

    def take(self, chunk: Chunk) -> list[Frame]:
        """Take bytes; note what they say."""
        self.heard_bytes += len(chunk.data)
        frames = self._framer.feed(chunk.data, chunk.t_ns)
        for frame in frames:
            self._note(frame)
        return frames

    def _note(self, frame: Frame) -> None:
        if frame.kind is Kind.PROMPT:
            self.port_name = frame.text
            self.greeted = self._last is not Kind.REPLY
        elif frame.kind is Kind.REPLY:
            self.answered = self.replies = True
            self._answers.append(frame.text)
        elif frame.kind.checked:
            self.checked = True
            self.ids.add(frame.message_id)
            self.time_status = frame.time_status or self.time_status
            if frame.port_address is not None and not self.port_name:
                self.port_name = _PORT_OF_ADDRESS.get(frame.port_address >> 5, "")
            said = parse(frame) if frame.is_response or frame.message_id in _ABOUT_ITSELF else None
            if isinstance(said, Response):
                self.answered = self.replies = True
                self._answers.append("OK" if said.ok else f"ERROR:{said.text}")
            elif isinstance(said, Version):
                self.answered, self.version = True, said
            elif isinstance(said, InsConfig):
                self.config = said
        self._last = frame.kind


def _word(status: TimeStatus | int) -> str:
    return status.name if isinstance(status, TimeStatus) else str(status)
