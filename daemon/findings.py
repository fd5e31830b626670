"""What was found on a port to checks: a line each in an operator's words, and what to do."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

from polecal.daemon.config import Laser, Navigation
from polecal.daemon.control import Code
from polecal.daemon.navigation import name_of
from polecal.drivers.novatel_span import InsStatus, accuracy, position_type, reference_point
from polecal.drivers.novatel_span.enums import (
    FINE_TIME,
    Component,
    InsOffset,
    MessageId,
    UtcStatus,
)
from polecal.drivers.novatel_span.logs import InsConfig, Time, Version
from polecal.drivers.novatel_span.probe import Probe as SpanProbe
from polecal.drivers.sick_lms.probe import Probe as LmsProbe
from polecal.drivers.sick_lms.telegrams import POLLUTED

State = Literal["ok", "warn", "fault", "unknown"]

_POWER_UP_BAUD = 9600
_BAD_SHARE = 0.01  # of frames, from which a line is bad
_CLOCK_S = 1.0  # by which the host's clock may be off: it only names sessions
_DAY_S, _ROLLOVER_S = 86400, 1024 * 604800  # GPS counts its weeks in 10 bits
_NOVATEL_MARKS = (b"\xaa\x44", b"#", b"<OK", b"<ERROR", b"$GP")
_JUMPER = "pins 7 and 8 joined in the laser's plug make its line RS-422, without that it is RS-232"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of a doctor's report; ``code`` is the exit code that it asks for."""

    name: str
    state: State
    what: str
    hint: str = ""
    code: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Give it as it is printed in JSON."""
        return {"name": self.name, "state": self.state, "what": self.what, "hint": self.hint}


def ok(name: str, what: str) -> Check:
    """Make a check of what is as it should be."""
    return Check(name, "ok", what)


def warn(name: str, what: str, hint: str) -> Check:
    """Make a check of what can be worked with, or waited for."""
    return Check(name, "warn", what, hint, Code.DEGRADED)


def fault(name: str, what: str, hint: str, code: int = Code.DEVICE) -> Check:
    """Make a check of what stops a calibration."""
    return Check(name, "fault", what, hint, code)


def unknown(name: str, what: str, hint: str = "") -> Check:
    """Make a check of what could not be told."""
    return Check(name, "unknown", what, hint)


def of_laser(laser: Laser, found: LmsProbe, instead: SpanProbe | None) -> list[Check]:
    """Tell of a laser's port; ``instead`` is what a search for a receiver found there."""
    name = laser.name
    line = f"{name} line"
    if laser.baud in found.cannot:
        return [
            fault(
                line,
                f"the adapter cannot do {laser.baud} bit/s",
                "use one that can (for 500000 bit/s an FTDI one), or set baud 38400",
            )
        ]
    if found.baud is None or found.status is None:
        if instead is not None and (instead.baud or instead.checked):
            return [
                _exchanged(
                    line, "a NovAtel receiver", instead.baud or instead.checked or 0, "laser and receiver"
                )
            ]
        return [_no_laser(line, found)]
    status = found.status
    if found.baud == laser.baud:
        checks = [ok(line, f"{found.baud} bit/s")]
    elif found.baud == _POWER_UP_BAUD:
        checks = [ok(line, f"{found.baud} bit/s, as after power-up: polecal takes it to {laser.baud}")]
    else:
        checks = [
            warn(
                line,
                f"the laser is at {found.baud} bit/s, not at {laser.baud}",
                "polecal takes it there at each start; it was left so, or is set so for good",
            )
        ]
    version = f"{found.identity or 'does not say its type'}, firmware {status.software.strip()}"
    if found.identity and not found.identity.startswith("LMS"):
        checks.append(
            fault(f"{name} laser", f"{found.identity!r} is no LMS laser", "correct the laser's port")
        )
    elif found.identity and ("S14" in found.identity) != (laser.reflectivity == "s14"):
        checks.append(
            fault(
                f"{name} laser",
                f"{version}: the configuration is for another type",
                "an S14 needs reflectivity s14, fov_deg 90 and resolution_deg 0.5; no other type can do that",
            )
        )
    else:
        checks.append(ok(f"{name} laser", version))
    return [*checks, _health(f"{name} health", found)]


def _health(name: str, found: LmsProbe) -> Check:
    assert found.status is not None
    errors = found.errors.faults if found.errors else ()
    now = [error.text for error in errors if not error.past]
    if now:
        return fault(
            name,
            f"the laser reports: {'; '.join(now)}",
            "clean its window, then switch it off and on; if it stays, it needs the maker's service",
        )
    if found.status.defect:
        return fault(name, "the laser says that it is defect", "switch it off and on; else have it serviced")
    if found.status.status & POLLUTED:
        return warn(name, "the laser's window is dirty", "clean it with a soft, damp cloth")
    past = [error.text for error in errors if error.past]
    return ok(name, f"no fault now{'; past: ' + ', '.join(past) if past else ''}")


def _no_laser(name: str, found: LmsProbe) -> Check:
    rates = _rates(found.heard)
    if any(_echo(heard, found.sent) for heard in found.heard.values()):
        return _echoes(name)
    for rate, count in found.frames.items():
        if count:
            return fault(
                name,
                f"a laser is heard at {rate} bit/s, but does not hear",
                "check the wires from the host to the laser: a broken pair, or its + and − exchanged",
            )
    for rate, heard in found.heard.items():
        if any(mark in heard for mark in _NOVATEL_MARKS[2:]) or heard.count(_NOVATEL_MARKS[0]) > 1:
            return _exchanged(name, "a NovAtel receiver", rate, "laser and receiver")
    if not any(found.heard.values()):
        return fault(
            name,
            f"not a byte comes at {rates} bit/s",
            f"check the laser's power (it needs a minute to start) and the data cable; {_JUMPER}",
        )
    return fault(
        name,
        f"bytes come, but at none of {rates} bit/s do they make a telegram",
        f"check the + and − of the RS-422 pairs, and that adapter and laser speak the same: {_JUMPER}",
    )


def of_receiver(navigation: Navigation, found: SpanProbe, instead: LmsProbe | None) -> list[Check]:
    """Tell of the receiver's port; ``instead`` is what a search for a laser found there."""
    line = "span line"
    if navigation.baud in found.cannot:
        return [fault(line, f"the adapter cannot do {navigation.baud} bit/s", "use another, or a lower baud")]
    if found.baud is None:
        if instead is not None and instead.baud:
            return [_exchanged(line, "a laser", instead.baud, "laser and receiver")]
        return [_no_receiver(line, found)]
    if found.baud == navigation.baud:
        checks = [ok(line, f"{found.baud} bit/s")]
    else:
        checks = [
            warn(
                line,
                f"the receiver is at {found.baud} bit/s, not at {navigation.baud}",
                "polecal takes it there at each start; to keep it: SERIALCONFIG on its port, then SAVECONFIG",
            )
        ]
    checks.append(ok("span receiver", _model(found.version)))
    checks += [_time(navigation, found), _ins(found), _position(navigation, found)]
    return [*checks, _lever_arm(found), _clock(found)]


def _no_receiver(name: str, found: SpanProbe) -> Check:
    rates = _rates(found.heard)
    if found.checked is not None:
        return fault(
            name,
            f"logs come at {found.checked} bit/s, but the receiver does not answer",
            "check the wire from the host to the receiver; else, from another port of it: "
            "INTERFACEMODE COM1 NOVATEL NOVATEL ON",
        )
    if any(_echo(heard, found.sent) for heard in found.heard.values()):
        return _echoes(name)
    if not any(found.heard.values()):
        return fault(
            name,
            f"not a byte comes at {rates} bit/s",
            "check the receiver's power, the cable, and that its port is set to the cable's RS-232 or RS-422",
        )
    return fault(
        name,
        f"bytes come, but at none of {rates} bit/s do they make a log",
        "check that cable, adapter and the receiver's port speak the same, RS-232 or RS-422, "
        "and the + and − of the pairs",
    )


def _model(version: Version | None) -> str:
    for part in version.components if version else ():
        if part.component == Component.GPSCARD:
            return f"NovAtel {part.hardware}, model {part.model}, firmware {part.software}"
    return "NovAtel receiver"


def _time(navigation: Navigation, found: SpanProbe) -> Check:
    name, status = "span time", found.time_status
    told = name_of(status)
    if status is None:
        return unknown(name, "the receiver does not tell how well it knows the time")
    if told not in navigation.time_status:
        return warn(
            name,
            f"the receiver's time is only {told}: no pulse per second, no inertial logs",
            "check the antenna and its cable, under open sky; from cold it takes a few minutes",
        )
    said = found.said.get(MessageId.TIME)
    if isinstance(said, Time) and said.utc_status != UtcStatus.VALID:
        return warn(
            name,
            f"{told}, but UTC is not known: the host's clock cannot be checked",
            "leave it under open sky for a quarter of an hour: the offset comes with the almanac",
        )
    return ok(name, f"{told}{', UTC known' if isinstance(said, Time) else ''}")


def _ins(found: SpanProbe) -> Check:
    name = "span INS"
    for message in (MessageId.INSPVAX, MessageId.INSPVAS):
        status = getattr(found.said.get(message), "ins_status", None)
        if status is None:
            continue
        told = name_of(status)
        if status == InsStatus.INS_SOLUTION_GOOD:
            return ok(name, str(told))
        meaning = getattr(status, "meaning", "nothing is used before it is good")
        hint = "drive straight, briskly, with a few turns until it is aligned"
        return warn(name, f"not aligned, {told}: {meaning}", hint)
    if not _fine(found):
        return unknown(name, "no inertial log comes before the receiver knows the time")
    refused = "; ".join(f"{log}: {why}" for log, why in found.refused.items() if log.startswith("INSPVA"))
    return fault(
        name,
        f"no inertial log comes ({refused or 'nothing came'})",
        "its model must include SPAN (see VERSION), and have an IMU that is connected and powered",
    )


def _position(navigation: Navigation, found: SpanProbe) -> Check:
    name = "span position"
    if not _fine(found):
        return unknown(name, "no position comes before the receiver knows the time")
    order = (MessageId.INSPVAX, MessageId.BESTPOS, MessageId.BESTGPSPOS)
    kinds = [kind for each in order if (kind := position_type(found.said.get(each))) is not None]
    if not kinds:
        return unknown(name, "the receiver does not tell what its position rests on")
    told = name_of(kinds[0])
    if told not in navigation.position_types:
        return warn(
            name,
            f"the position is only {told}",
            "check that corrections (RTK, PPP, DGPS) reach the receiver, and its antenna's sky",
        )
    for said in found.said.values():
        sigma = accuracy(said)
        if sigma is not None:
            worst = max(sigma.position_m[:2])
            most = navigation.max_sigma.position_m
            if worst > most:
                hint = "wait for it to converge; then drive turns"
                return warn(name, f"{told}, σ {worst:.2f} m: at most {most:g} m is used", hint)
            return ok(name, f"{told}, σ {worst:.2f} m")
    return ok(name, str(told))


def _fine(found: SpanProbe) -> bool:
    return found.time_status is None or found.time_status in FINE_TIME


def _lever_arm(found: SpanProbe) -> Check:
    name, said = "span lever arm", found.said.get(MessageId.INSCONFIG)
    if not isinstance(said, InsConfig):
        return unknown(
            name,
            "this receiver does not tell it",
            "see that SETIMUTOANTOFFSET (SETINSTRANSLATION ANT1) holds the antenna's place",
        )
    arms = [item.xyz for item in said.translations if item.offset == InsOffset.ANT1]
    if not any(any(xyz) for xyz in arms):
        return warn(
            name,
            "from IMU to antenna it is zero",
            "measure it and set it: SETINSTRANSLATION ANT1 X Y Z (m, IMU axes), then SAVECONFIG; "
            "each position is off by it",
        )
    told = ", ".join(f"{value:g}" for value in arms[0])
    return ok(name, f"IMU to antenna ({told}) m; poses speak of {reference_point(said)}")


def _clock(found: SpanProbe) -> Check:
    name, said = "clock", found.said.get(MessageId.TIME)
    if not isinstance(said, Time) or said.utc_status != UtcStatus.VALID:
        return unknown(name, "the host's clock cannot be compared without UTC from the receiver")
    try:
        gps = datetime(
            said.utc_year, said.utc_month, said.utc_day, said.utc_hour, said.utc_minute, tzinfo=UTC
        )
    except ValueError:
        return unknown(name, "the receiver's UTC is no date")
    gps += timedelta(milliseconds=said.utc_ms)
    ago = timedelta(microseconds=(time.monotonic_ns() - found.came_ns[MessageId.TIME]) / 1000)
    off_s = (datetime.now(UTC) - ago - gps).total_seconds()
    if abs(off_s) <= _CLOCK_S:
        return ok(name, f"the host's clock agrees with GPS to {abs(off_s):.1f} s")
    if (rollovers := round(abs(off_s) / _ROLLOVER_S)) and abs(abs(off_s) - rollovers * _ROLLOVER_S) < _DAY_S:
        hint = "its firmware does not know this GPS week: update it (a calibration does not mind)"
        return warn(name, f"the receiver's date is off by {1024 * rollovers} weeks", hint)
    return warn(
        name,
        f"the host's clock is {_long(abs(off_s))} {'ahead of' if off_s > 0 else 'behind'} GPS",
        "sessions would be dated wrong (nothing else): `sudo timedatectl set-ntp true`, or set it by hand",
    )


def _long(seconds: float) -> str:
    for unit, length in (("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.1f} s"


def _exchanged(name: str, what: str, rate: int, which: str) -> Check:
    return fault(
        name,
        f"{what} is on this port, at {rate} bit/s",
        f"the ports of {which} are exchanged, in the configuration or at the plugs",
    )


def _echoes(name: str) -> Check:
    return fault(
        name,
        "what is sent comes back: an echo",
        "transmit and receive are joined: a null modem too much or too few, a loop-back plug, "
        "or an RS-422 adapter in two-wire mode (set it to four-wire, echo off)",
    )


def _echo(heard: bytes, sent: bytes) -> bool:
    return sent.strip() in heard


def _rates(heard: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(heard)))


# What STATUS tells of a daemon's devices, for ports that are its own.


def of_status(status: dict[str, Any]) -> list[Check]:
    """Tell what a running daemon knows of its devices."""
    checks = []
    for device in status.get("devices") or []:
        name = str(device.get("name"))
        where = f"{device.get('port')}, held by polecald"
        if device.get("state") == "streaming":
            who = f", {device['identity']}" if device.get("identity") else ""
            checks.append(ok(f"{name} port", f"{where}{who}"))
            checks.append(_stream(f"{name} stream", device))
        else:
            said = device.get("problem") or f"the device is {device.get('state')}"
            checks.append(fault(f"{name} port", f"{where}: {said}", str(device.get("hint") or "wait for it")))
        health = device.get("health") or {}
        if health.get("faults"):
            told = "; ".join(health["faults"])
            checks.append(fault(f"{name} health", told, "switch the laser off and on"))
        elif health.get("polluted"):
            checks.append(warn(f"{name} health", "the laser's window is dirty", "clean it"))
        ins = device.get("ins_status")
        if ins is not None:
            good = ins == InsStatus.INS_SOLUTION_GOOD.name
            hint = "drive straight, briskly, with a few turns"
            checks.append(ok("span INS", ins) if good else warn("span INS", ins, hint))
    if notes := status.get("notes"):
        checks.append(warn("notes", "; ".join(map(str, notes)), "see `polecal-field status`"))
    return checks


def _stream(name: str, device: dict[str, Any]) -> Check:
    told = f"{device.get('rate_hz')} Hz, {device.get('frames')} frames, {device.get('bad_frames')} bad"
    frames, bad = device.get("frames") or 0, device.get("bad_frames") or 0
    if bad > _BAD_SHARE * max(frames, 1):
        return warn(name, told, "more than 1 % spoilt: check shield, ground and length of the cable")
    if device.get("reconnects"):
        return warn(name, f"{told}, lost {device['reconnects']} times", "check plugs and power")
    return ok(name, told)
