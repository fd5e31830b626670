"""Recorded chunks to calibrations: one deterministic function, live and in replay.

What it gives depends on nothing but the configuration and the chunks, in their order.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from polecal.calib import CalibrationError, Mount, Pass, Result, estimate
from polecal.calib.coverage import headings
from polecal.calib.geometry import wrap
from polecal.daemon import results
from polecal.daemon.config import SPAN, Config, Laser
from polecal.daemon.fusion import LaserChannel
from polecal.daemon.navigation import Navigation, OnPose, name_of
from polecal.daemon.passes import StoredPass
from polecal.daemon.pulse import Pulse
from polecal.daemon.routine import OnTransition, Routine, State
from polecal.daemon.trajectory import Trajectory
from polecal.drivers.clock import Clock
from polecal.drivers.sick_lms import Decoded

OnPass = Callable[[str, StoredPass], None]
"""Takes (laser's name, pass) of every pass that is closed."""
OnScan = Callable[[str, int, Decoded], None]
"""Takes (laser's name, host time at which its telegram began, scan) of every scan of the right variant."""

_COSTS = 40  # after the last so many passes, for who looks on
_ABSURD_SIGMAS = 20.0  # off the hand measurement: of the default 0.1 m and 5 degrees, 2 m and 100 degrees


class _LaserRun:
    """One laser: its channel, the passes it has given, and what they come to."""

    def __init__(
        self,
        config: Config,
        laser: Laser,
        trajectory: Trajectory,
        gps_clock: Clock,
        on_scan: OnScan | None,
    ) -> None:
        self.name = laser.name
        self.pulse = Pulse()
        self.setup = results.setup_of(config, laser)
        self.channel = LaserChannel(
            laser,
            config,
            trajectory,
            gps_clock,
            self.pulse.beat,
            on_scan=partial(on_scan, laser.name) if on_scan is not None else None,
        )
        self.result: Result | None = None
        self.costs_m: deque[float] = deque(maxlen=_COSTS)
        self._passes: dict[int, list[Pass]] = {}  # by place

    def take(self, stored: StoredPass) -> None:
        self._passes.setdefault(stored.place, []).append(stored.moments)
        self.estimate(everywhere=False)
        if self.result is not None:
            self.costs_m.append(round(self.result.cost_m, 5))

    def estimate(self, *, everywhere: bool) -> None:
        """Calibrate on the passes of the pole: the thin reflector seen most evenly from all sides."""
        could_be = [
            passes for place, passes in self._passes.items() if self.channel.places.could_be_pole(place)
        ]
        if not could_be:
            self.result = None  # what was thin from one side has turned out to be a plate
            return
        passes = max(could_be, key=self._progress)
        try:
            self.result = estimate(passes, self.setup, everywhere=everywhere)
        except CalibrationError:
            return
        # One pass over level ground may put the laser anywhere; what is placed by that is lost.
        self.channel.mount = self.result.mount if self._could_be(self.result.mount) else self.setup.measured

    def _could_be(self, mount: Mount) -> bool:
        """Say whether the hand measurement could be so wrong; if it is not absurd, let the data lead."""
        shift = mount.vector - self.setup.measured.vector
        shift[3:] = wrap(shift[3:])
        most = _ABSURD_SIGMAS * self.setup.measured_sigma.vector
        return bool((np.abs(shift) <= most).all())

    def _progress(self, passes: Iterable[Pass]) -> int:
        """Give how many pole returns count, of those that each slice needs."""
        counts: Counter[int] = Counter()
        for one in passes:
            counts.update(one.pole_returns)
        return sum(min(count, self.setup.need.min_pole_returns) for count in counts.values())


class Pipeline:
    """All that happens between the bytes and the verdict.

    ``session`` and ``created`` go into the calibration as they are. The callbacks are called from
    within `feed`.
    """

    def __init__(
        self,
        config: Config,
        *,
        session: str = "",
        created: str = "",
        on_pass: OnPass | None = None,
        on_transition: OnTransition | None = None,
        on_scan: OnScan | None = None,
        on_pose: OnPose | None = None,
    ) -> None:
        self.routine = Routine(on_transition)
        self._session, self._created = session, created
        self._on_pass = on_pass
        self._need = config.routine
        self._navigation = Navigation(config.navigation, on_pose)
        self._lasers = {
            laser.name: _LaserRun(config, laser, self._navigation.trajectory, self._navigation.clock, on_scan)
            for laser in config.lasers
        }

    def begin(self, t_ns: int) -> None:
        """Start the run at host time ``t_ns``."""
        self.routine.to(State.CONNECTING, t_ns, "asked to start")

    def feed(self, device: str, t_ns: int, data: bytes) -> None:
        """Take a chunk that was read from a device at host time ``t_ns`` (CLOCK_MONOTONIC ns).

        Once the run has ended, nothing changes any more.
        """
        if not self.routine.running:
            return
        before = self.routine.state
        if device == SPAN:
            self._navigation.feed(t_ns, data)
        elif device in self._lasers:
            self._lasers[device].channel.feed(t_ns, data)
        else:
            return
        self.tick(t_ns)
        news = self.routine.state is not before
        for laser in self._lasers.values():
            for stored in laser.channel.fuse():
                self._take(laser, stored)
                news = True
        if news:  # a verdict changes with a pass, and counts while collecting
            self._conclude(t_ns)

    def tick(self, t_ns: int) -> None:
        """Let time go on to host time ``t_ns``, also where nothing comes any more."""
        self._navigation.tick(t_ns)
        self._advance(t_ns)

    def finish(self, t_ns: int, why: str) -> None:
        """Calibrate with what there is, and end the run."""
        if not self.routine.running:
            return
        self.routine.to(State.CALIBRATING, t_ns, why)
        for laser in self._lasers.values():
            for stored in laser.channel.end():
                self._take(laser, stored)
            laser.estimate(everywhere=True)
        reasons = [
            f"{laser.name}: {reason}"
            for laser in self._lasers.values()
            for reason in self._entry(laser)["verdict"]["reasons"]
        ]
        state = State.REJECTED if reasons else State.ACCEPTED
        self.routine.to(state, t_ns, "; ".join(reasons) or "all criteria are met")

    def status(self) -> dict[str, Any]:
        """Give the part of STATUS that follows from the data."""
        return {
            "state": str(self.routine.state),
            "lasers": [self._entry(laser) for laser in self._lasers.values()],
            "next": self._next(),
            "notes": self._notes(),
        }

    def device(self, name: str) -> dict[str, Any]:
        """Give the part of a device's STATUS that follows from its data."""
        if name == SPAN:
            return self._navigation.device()
        laser = self._lasers[name]
        return {
            "rate_hz": round(laser.pulse.rate_hz, 2),
            "frames": laser.channel.framer.frames,
            "bad_frames": laser.channel.framer.bad_frames,
        }

    def gps_ns(self, t_ns: int) -> int | None:
        """Give the GPS time at host time ``t_ns``, None while the receiver's clock is not known."""
        clock = self._navigation.clock
        return clock.to_device(t_ns) if clock.locked else None

    def calibration(self) -> dict[str, Any] | None:
        """Give the content of ``calibration.yaml``, None before there is a result for every laser."""
        lasers = []
        for laser in self._lasers.values():
            if laser.result is None:
                return None
            lasers.append(
                results.calibration(laser.name, laser.setup, laser.result, self._session, self._created)
                | {"reference_point": self._navigation.reference_point}
            )
        return {"state": str(self.routine.state), "lasers": lasers}

    def _advance(self, t_ns: int) -> None:
        state = self.routine.state
        if (
            state is State.CONNECTING
            and self._navigation.pulse.count
            and all(laser.pulse.count for laser in self._lasers.values())
        ):
            self.routine.to(State.ALIGNING, t_ns, "all devices stream")
        elif state is State.ALIGNING and self._navigation.ready:
            self.routine.to(State.COLLECTING, t_ns, "the navigation solution is good")
        elif state is State.COLLECTING and self._navigation.lost:
            why = "; ".join(self._navigation.why_not) or f"{name_of(self._navigation.ins_status)}"
            self.routine.to(State.ALIGNING, t_ns, f"no good navigation solution for 2 s: {why}")

    def _take(self, laser: _LaserRun, stored: StoredPass) -> None:
        if self._on_pass is not None:
            self._on_pass(laser.name, stored)
        laser.take(stored)

    def _conclude(self, t_ns: int) -> None:
        if self.routine.state is not State.COLLECTING:
            return
        verdicts = [laser.result.verdict for laser in self._lasers.values() if laser.result is not None]
        if len(verdicts) == len(self._lasers) and all(verdict.accepted for verdict in verdicts):
            self.finish(t_ns, "the criteria are met")
        elif any(verdict.hopeless for verdict in verdicts):
            self.finish(t_ns, "more of the same driving would not help")

    def _entry(self, laser: _LaserRun) -> dict[str, Any]:
        dropped = {reason: count for reason, count in laser.channel.dropped.items() if count}
        told = {"dropped": dropped, "need": asdict(laser.setup.need), "costs_m": list(laser.costs_m)}
        return results.entry(laser.name, laser.setup, laser.result) | told

    def _next(self) -> str:
        match self.routine.state:
            case State.CONNECTING:
                return "wait: not all devices stream yet"
            case State.ALIGNING:
                return "drive until the navigation has aligned: straight, briskly, with a few turns"
            case State.COLLECTING:
                missing = {
                    part["slice"]
                    for laser in self._lasers.values()
                    for part in results.entry(laser.name, laser.setup, laser.result)["coverage"]
                    if not part["done"]
                }
                every, width = set(range(360 // self._need.slice_deg)), self._need.slice_deg
                if missing == every:
                    return "drive past the pole, within 7 m of it, from any side"
                if len(missing) > len(every) / 2:
                    seen = headings(sorted(every - missing), width)
                    return f"drive past the pole from any side but heading {seen}"
                if missing:
                    return f"drive past the pole heading {headings(sorted(missing), width)}"
                return "drive more passes of the pole, from all sides" + self._to_know_more()
            case _:
                return ""

    def _to_know_more(self) -> str:
        """Say what would make better known what is not known well enough, if that is all that is missing."""
        for laser in self._lasers.values():
            if laser.result is not None and any("known to" in why for why in laser.result.verdict.reasons):
                return f"; {results.weakest(laser.setup, laser.result).drive}"
        return ""

    def _notes(self) -> list[str]:
        notes = self._navigation.why_not + self._navigation.notes if self.routine.running else []
        for laser in self._lasers.values():
            result = laser.result
            if result is None or not all(part.done for part in result.slices):
                continue  # most of it will be told by the passes that are still missing
            if set(result.held) - laser.setup.hold:
                weak = results.weakest(laser.setup, result)
                notes.append(f"{laser.name}: {weak.name} is held as measured; to free it: {weak.drive}")
            if "time_s" not in result.extras:
                notes.append(
                    f"{laser.name}: a time offset cannot be told from x: pass the pole in reverse, "
                    "or at another speed"
                )
        return notes
