"""An LMS-2xx on a port, found as it is and brought to streaming what is wanted (sheet sections 7 and 8)."""

from __future__ import annotations

import contextlib
import struct
import time
from dataclasses import asdict, dataclass, replace
from typing import Literal

from polecal.drivers.device import Device
from polecal.drivers.errors import DeviceError, DeviceLost, DeviceNotFound, DeviceProtocolError
from polecal.drivers.port import Chunk, Port, Tap
from polecal.drivers.sick_lms.configuration import (
    CENTIMETRES,
    MILLIMETRES,
    Configuration,
    ConfigurationRead,
    ConfigurationWritten,
    WriteConfiguration,
)
from polecal.drivers.sick_lms.conversation import (
    EEPROM_S,
    MODE_S,
    QUIET_S,
    Conversation,
    NoReply,
    NotAllowed,
)
from polecal.drivers.sick_lms.framer import Frame
from polecal.drivers.sick_lms.health import Errors, Status
from polecal.drivers.sick_lms.scans import MAX_RANGE_M, MEASURING_MODES, SCAN_CODES
from polecal.drivers.sick_lms.telegrams import (
    BAUD_MODES,
    POLLUTED,
    ModeSwitched,
    OperatingMode,
    PowerOn,
    RequestConfiguration,
    RequestErrors,
    RequestStatus,
    RequestType,
    SwitchMode,
    SwitchVariant,
    TypeText,
    VariantSwitched,
    energy_spans,
)

Reflectivity = Literal["levels", "energy", "s14"]
Unit = Literal["cm", "mm"]

_RATES = (500000, 38400, 19200, 9600)
_ROUNDS = 6  # through all rates; the laser overlooks a request now and then
_FOUND_WITHIN_S = 1.0
_SETTLE_S = 0.25  # after a change of rate (sheet section 7)
_WRITES = 3  # of one configuration, where the line swallows the answers
_HEALTH_NS = 60_000_000_000
_QUIET_NS = round(QUIET_S * 1e9)

_LEVELS_MODE = 0x01  # measuring modes, sheet section 3.3
_ENERGY_MODE = 0x0E
_ENERGY_BEAMS = 199  # what fits an F5 of 814 bytes with indices (sheet section 5)
_ONE_IN = {38400: 5, 19200: 9, 9600: 17}  # scans of 0.25 degrees that get through (sheet section 6)
_UNITS = {"cm": 0.01, "mm": 0.001}
_S14 = "S14"
_S14_BEAMS = 181
_NOVATEL_MARKS = (b"\xaa\x44", b"#", b"<OK", b"$GP")


def refusal(
    fov_deg: float,
    resolution_deg: float,
    reflectivity: str,
    baud: int,
    *,
    unit: str = "cm",
    max_range_m: float = 80.0,
) -> str:
    """Why no laser can do this, in words; empty if one can (sheet sections 3.3, 5 and 7)."""
    if baud not in BAUD_MODES:
        return f"the laser knows {', '.join(map(str, sorted(BAUD_MODES)))} bit/s, not {baud}"
    if reflectivity not in ("levels", "energy", "s14"):
        return f"reflectivity is levels, energy or s14, not {reflectivity}"
    if unit not in _UNITS:
        return f"the laser's unit is cm or mm, not {unit}"
    mode = _ENERGY_MODE if reflectivity == "energy" else _LEVELS_MODE
    largest_m = min(((1 << MEASURING_MODES[mode].range_bits) - 9) * _UNITS[unit], MAX_RANGE_M)
    if max_range_m > largest_m:
        return f"in {unit} the laser's numbers end at {largest_m:.2f} m, not {max_range_m:g} m: use cm"
    if reflectivity == "s14":
        fits = (fov_deg, resolution_deg) == (90, 0.5)
        return "" if fits else "an S14 laser sees 90° at 0.5° and nothing else"
    if fov_deg not in (100, 180) or resolution_deg not in (0.25, 0.5, 1):
        return f"the laser does 100° or 180° at 0.25°, 0.5° or 1°, not {fov_deg:g}° at {resolution_deg:g}°"
    if (fov_deg, resolution_deg) == (180, 0.25):
        return "180° at 0.25° exists only as interlaced scans, which have no reflectivity: use 100°, or 0.5°"
    beams = round(fov_deg / resolution_deg) + 1
    if reflectivity == "energy" and beams > _ENERGY_BEAMS:
        return f"a telegram with energies holds {_ENERGY_BEAMS} beams, not {beams}: use 1°, or levels"
    if resolution_deg == 0.25 and baud in _ONE_IN:
        return f"at {baud} bit/s only one scan in {_ONE_IN[baud]} of 0.25° gets through: use 500000, or 0.5°"
    return ""


@dataclass(frozen=True, slots=True)
class Health:
    """What the laser last said of itself.

    ``faults`` are the entries of its error list that hold now, in words; ``past`` those that do not;
    ``pollution`` the window's eight channels as a share of their calibration (None: not calibrated).
    """

    faults: tuple[str, ...] = ()
    past: tuple[str, ...] = ()
    pollution: tuple[float | None, ...] = ()
    polluted: bool = False
    defect: int = 0


class SickLms(Device):
    """The laser's conversation, on the template of `Device`.

    ``eeprom_writes`` counts the configurations written; ``measuring_mode`` is the one in force once it
    streams. Raises DeviceError for a set-up that no laser can do.
    """

    kind = "sick_lms"

    def __init__(
        self,
        name: str,
        path: str,
        baud: int,
        tap: Tap,
        *,
        fov_deg: float = 100,
        resolution_deg: float = 0.25,
        reflectivity: Reflectivity = "levels",
        resting_baud: int = 9600,
        unit: Unit = "cm",
        max_range_m: float = 80.0,
    ) -> None:
        super().__init__(name, path, baud, tap)
        reason = refusal(fov_deg, resolution_deg, reflectivity, baud, unit=unit, max_range_m=max_range_m)
        if not reason and resting_baud not in BAUD_MODES:
            reason = f"the laser cannot rest at {resting_baud} bit/s"
        if reason:
            raise DeviceError(f"{name}: {reason}", "correct the laser's entry in the configuration")
        self.fov_deg = fov_deg
        self.resolution_deg = resolution_deg
        self.reflectivity: Reflectivity = reflectivity
        self.resting_baud = resting_baud
        self.unit: Unit = unit
        self.measuring_mode = _LEVELS_MODE
        self.eeprom_writes = 0
        self.health = Health()
        self._talk: Conversation | None = None
        self._refused_data: set[bytes] = set()  # configurations that were written and did not hold
        self._health_due_ns = 0
        self._heard_ns = 0

    def about(self) -> dict[str, object]:
        """Give its health, how its reflectivity comes, and how often its EEPROM was written."""
        return {
            "health": asdict(self.health),
            "reflectivity": self.reflectivity,
            "eeprom_writes": self.eeprom_writes,
        }

    def _set_up(self, port: Port) -> None:
        self._talk = None
        talk = Conversation(port)
        self._find(talk)
        self._talk = talk
        self.identity = talk.ask(RequestType(), TypeText).text.strip()
        self._check_type()
        status = talk.ask(RequestStatus(), Status)
        self._log.info("found", identity=self.identity, baud=port.baud, version=status.software.strip())
        self._go_to(talk, self.baud)
        self._set_variant(talk, status)
        try:
            self._stream(talk)
        except (NotConfigured, NotAllowed, NotSwitched) as error:
            if self.reflectivity != "energy":
                raise
            self._log.warning("no energies from this laser: going on with levels", problem=str(error))
            self.reflectivity = "levels"
            self._stream(talk)

    def _stream(self, talk: Conversation) -> None:
        self._configure(talk, _ENERGY_MODE if self.reflectivity == "energy" else _LEVELS_MODE)
        self._look_after(talk)
        self._start(talk)

    def _find(self, talk: Conversation) -> None:
        """Go to the laser's rate, and stop it there if it streams. Raises DeviceNotFound."""
        rates = [self.baud, *(rate for rate in _RATES if rate != self.baud)]
        heard: dict[int, str] = {}
        for _ in range(_ROUNDS):
            for rate in rates:
                try:
                    talk.set_baud(rate)
                except DeviceLost:
                    raise
                except DeviceError:
                    if rate == self.baud:
                        raise
                    continue  # this adapter cannot: the laser is not there, or cannot be reached there
                with contextlib.suppress(NotAllowed):
                    try:
                        _switch(talk, OperatingMode.ON_REQUEST, tries=1, within_s=_FOUND_WITHIN_S)
                    except NotSwitched:
                        pass  # it is there; what ails it, its status says
                    except NoReply:
                        heard[rate] = _sounds_like(talk)
                        continue
                return
        raise _not_found(self.path, heard)

    def _check_type(self) -> None:
        if not self.identity.startswith("LMS"):
            raise DeviceProtocolError(
                f"{self.path}: {self.identity!r} is no LMS laser", "correct the laser's port"
            )
        if (_S14 in self.identity) != (self.reflectivity == "s14"):
            raise DeviceProtocolError(
                f"{self.path}: the laser is a {self.identity}, the configuration is for another type",
                "an S14 laser needs reflectivity s14, 90° and 0.5°; no other type can do that",
            )

    def _go_to(self, talk: Conversation, baud: int) -> None:
        """Bring the laser and the port to a rate; A0 still comes at the old one."""
        old = talk.port.baud
        if old == baud:
            return
        for _ in range(3):
            with contextlib.suppress(NoReply):  # it may have switched all the same
                _switch(talk, BAUD_MODES[baud], tries=1)
            talk.pause(_SETTLE_S)
            talk.set_baud(baud)
            with contextlib.suppress(NoReply):
                talk.ask(RequestStatus(), Status, tries=3)
                return
            talk.set_baud(old)
        raise DeviceProtocolError(
            f"{self.path}: the laser was at {old} bit/s and is not to be heard at {baud}",
            "500000 bit/s needs RS-422 (pins 7 and 8 joined in the laser's plug) and an adapter that can "
            "do it; else set baud 38400. Switch the laser off and on to bring it back",
        )

    def _set_variant(self, talk: Conversation, status: Status) -> None:
        wanted = (round(self.fov_deg), round(self.resolution_deg * 100))
        if self.reflectivity == "s14" or (status.fov_deg, status.resolution_cdeg) == wanted:
            return
        reply = talk.ask(SwitchVariant(*wanted), VariantSwitched, within_s=EEPROM_S)
        if not reply.accepted or (reply.fov_deg, reply.resolution_cdeg) != wanted:
            raise DeviceProtocolError(
                f"{self.path}: the laser refuses {self.fov_deg:g}° at {self.resolution_deg:g}°",
                f"this {self.identity} cannot do it: set another fov_deg and resolution_deg",
            )

    def _configure(self, talk: Conversation, measuring_mode: int) -> None:
        """Write the configuration if it is not what it should be; the EEPROM bears some thousand writes.

        Raises NotConfigured.
        """
        now = talk.ask(RequestConfiguration(), ConfigurationRead).configuration
        wanted = now.streaming(measuring_mode, MILLIMETRES if self.unit == "mm" else CENTIMETRES)
        self.measuring_mode = measuring_mode
        if wanted == now:
            return
        if wanted.data in self._refused_data:
            raise NotConfigured(
                f"{self.path}: the laser did not keep its configuration when it was last written",
                "it is not written again; restart polecal to try once more",
            )
        _switch(talk, OperatingMode.INSTALLATION, SwitchMode.installation().argument)
        try:
            back, answered = now, False
            for _ in range(_WRITES):
                answered = self._write(talk, wanted)
                back = talk.ask(RequestConfiguration(), ConfigurationRead, within_s=EEPROM_S).configuration
                if answered or back != now:
                    break
        finally:
            _switch(talk, OperatingMode.ON_REQUEST)
        if back != wanted:
            self._refused_data.add(wanted.data)
            raise NotConfigured(
                f"{self.path}: the laser took measuring mode {measuring_mode:02X} and the like, "
                f"but reads back {back.data.hex(' ')}",
                f"its firmware may not know them: {self.identity}",
            )

    def _write(self, talk: Conversation, configuration: Configuration) -> bool:
        """Write once; say whether the laser answered. What it then has, only reading back tells."""
        self.eeprom_writes += 1
        self._log.info("writing the laser's configuration", data=configuration.data.hex(" "))
        request = WriteConfiguration(configuration)
        try:
            talk.ask(request, ConfigurationWritten, tries=1, ack_s=EEPROM_S, within_s=EEPROM_S)
        except NoReply:
            return False
        return True

    def _start(self, talk: Conversation) -> None:
        if self.reflectivity == "energy":
            beams = round(self.fov_deg / self.resolution_deg) + 1
            _switch(talk, OperatingMode.STREAM_ENERGY, energy_spans((1, beams)))
        elif self.reflectivity == "s14":
            _switch(talk, OperatingMode.STREAM_S14, struct.pack("<2H", 1, _S14_BEAMS))
        else:
            _switch(talk, OperatingMode.STREAM)

    def _heard(self, chunk: Chunk) -> bool:
        talk = self._talk
        assert talk is not None
        # after a silence the rest of what was held will not come: what comes may be the power-on string
        quiet = chunk.t_ns - self._heard_ns > _QUIET_NS
        self._heard_ns = chunk.t_ns
        frames = talk.framer.close() if quiet else []
        frames += talk.framer.feed(chunk.data, chunk.t_ns)
        for frame in frames:
            if frame.command == PowerOn.code:
                raise DeviceProtocolError(
                    f"{self.name} on {self.path}: the laser has just started anew",
                    "look at its power supply; it is being set up again",
                )
            self._listen(frame, talk.port)
        if chunk.t_ns >= self._health_due_ns:
            self._health_due_ns = chunk.t_ns + _HEALTH_NS
            talk.port.write(RequestErrors().build())
        return any(frame.command in SCAN_CODES for frame in frames)

    def _listen(self, frame: Frame, port: Port) -> None:
        """Take the answers to what is asked of a streaming laser: its errors, and then its status."""
        try:
            if frame.command == Errors.code:
                self._note_errors(Errors.parse(frame))
                port.write(RequestStatus().build())
            elif frame.command == Status.code:
                self._note_status(Status.parse(frame))
        except DeviceProtocolError as error:
            self._log.warning("the laser's health does not read", problem=str(error))

    def _look_after(self, talk: Conversation) -> None:
        self._note_errors(talk.ask(RequestErrors(), Errors))
        self._note_status(talk.ask(RequestStatus(), Status))
        self._health_due_ns = time.monotonic_ns() + _HEALTH_NS

    def _note_errors(self, errors: Errors) -> None:
        faults = tuple(fault.text for fault in errors.faults if not fault.past)
        if faults != self.health.faults:
            self._log.warning("the laser's error list", faults=faults)
        past = tuple(fault.text for fault in errors.faults if fault.past)
        self.health = replace(self.health, faults=faults, past=past)

    def _note_status(self, status: Status) -> None:
        polluted = bool(status.status & POLLUTED)
        if polluted and not self.health.polluted:
            self._log.warning("the laser's window is dirty: clean it")
        shares = zip(status.pollution, status.pollution_calibration, strict=True)
        self.health = replace(
            self.health,
            pollution=tuple(now / new if new else None for now, new in shares),
            polluted=polluted,
            defect=status.defect,
        )

    def _leave(self, port: Port) -> None:
        if self._talk is None:
            return
        talk = self._talk
        talk.finish()
        for rate in dict.fromkeys((port.baud, self.baud)):  # a change of rate may have been under way
            with contextlib.suppress(NoReply):
                if port.baud != rate:
                    talk.set_baud(rate)
                _switch(talk, OperatingMode.ON_REQUEST, tries=3)
                break
        if port.baud != self.resting_baud:
            _switch(talk, BAUD_MODES[self.resting_baud], tries=2)
        self._log.info("left in request mode", baud=self.resting_baud)


class NotSwitched(DeviceProtocolError):
    """The laser refused a mode (A0 with 01 or 02)."""


class NotConfigured(DeviceProtocolError):
    """The laser did not keep what was written."""


def _switch(
    talk: Conversation,
    mode: OperatingMode,
    argument: bytes = b"",
    *,
    tries: int = 3,
    within_s: float = MODE_S,
) -> None:
    """Change the mode. Raises NotSwitched, and as `Conversation.ask`."""
    reply = talk.ask(SwitchMode(mode, argument), ModeSwitched, tries=tries, within_s=within_s)
    if reply.result:
        why = "its password is not the factory's" if mode == OperatingMode.INSTALLATION else "it has a fault"
        raise NotSwitched(
            f"{talk.port.path}: the laser refuses mode {mode:02X} {mode.name.lower()} "
            f"(A0 {reply.result:02X})",
            f"{why}, or its type lacks this: read its error list with polecal-field doctor",
        )


def _sounds_like(talk: Conversation) -> str:
    """Put in words what came instead of an answer; empty for silence."""
    if talk.framer.frames:
        return "a laser that does not answer"
    if not talk.heard:
        return ""
    if any(mark in talk.heard for mark in _NOVATEL_MARKS):
        return "a NovAtel receiver"
    text = sum(32 <= byte < 127 or byte in b"\r\n" for byte in talk.heard)
    return "text" if text > 0.95 * len(talk.heard) else "noise"


def _not_found(path: str, heard: dict[int, str]) -> DeviceNotFound:
    rates = ", ".join(map(str, sorted(heard)))
    sounds = {rate: sound for rate, sound in heard.items() if sound}
    if not sounds:
        return DeviceNotFound(
            f"{path}: no laser answers at {rates} bit/s: silence",
            "check the laser's power (it needs a minute to start) and the data cable",
        )
    what = "; ".join(f"{sound} at {rate}" for rate, sound in sorted(sounds.items()))
    if any("laser" in sound for sound in sounds.values()):
        hint = "the laser is heard but does not hear: check the wires from the host to the laser"
    elif any("NovAtel" in sound for sound in sounds.values()):
        hint = "the ports of laser and receiver are exchanged in the configuration, or at the plugs"
    else:
        hint = "check that this is the laser's port, and the polarity of its RS-422 pairs"
    return DeviceNotFound(f"{path}: no laser answers at {rates} bit/s; heard: {what}", hint)
