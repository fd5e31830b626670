"""Recorded chunks to calibrations: one deterministic function, live and in replay.

What it gives depends on nothing but the configuration and the chunks, in their order.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from polecal.calib import CalibrationError, Mount, Pass, Result, Verdict, estimate, residuals
from polecal.calib.acceptance import given_up
from polecal.calib.agreement import View, disagreements
from polecal.calib.coverage import headings
from polecal.calib.geometry import wrap
from polecal.calib.shared import Witness, share
from polecal.daemon import results, rows
from polecal.daemon.choices import Choice, meant, parse_name
from polecal.daemon.choices import name_of as pass_name
from polecal.daemon.config import SPAN, Config, Laser
from polecal.daemon.control import Code, Refused
from polecal.daemon.fusion import LaserChannel
from polecal.daemon.navigation import Navigation, OnPose, name_of
from polecal.daemon.passes import Kept, StoredPass, most_of_one
from polecal.daemon.passing import Passing
from polecal.daemon.past import Past
from polecal.daemon.pulse import Pulse
from polecal.daemon.route import LaserStand, Place, Stand
from polecal.daemon.routine import ENDED, OnTransition, Routine, State
from polecal.daemon.spill import Spill
from polecal.daemon.trajectory import Trajectory
from polecal.drivers.clock import Clock
from polecal.drivers.sick_lms import Decoded

OnPass = Callable[[str, StoredPass], None]
"""Takes (laser's name, pass) of every pass that is closed."""
OnScan = Callable[[str, int, Decoded], None]
"""Takes (laser's name, host time at which its telegram began, scan) of every scan of the right variant."""

GO_ON = "it was not calibrated: go on with it by `polecal-field start --continue`"
_COSTS = 40  # after the last so many passes, for who looks on
_FEW_LEFT = 10  # passes: from then on it is said that there may be no more
_ABSURD_SIGMAS = 20.0  # off the hand measurement: of the default 0.1 m and 5 degrees, 2 m and 100 degrees


class _LaserRun:
    """One laser: its channel, the passes it has given, and what they come to."""

    def __init__(
        self,
        config: Config,
        laser: Laser,
        trajectory: Trajectory,
        gps_clock: Clock,
        *,
        on_scan: OnScan | None,
        spill: Spill,
    ) -> None:
        self.name = laser.name
        self._spill = spill
        self.setup = results.setup_of(config, laser)
        self._on_scan = partial(on_scan, laser.name) if on_scan is not None else None
        self.result: Result | None = None
        self.alone: Result | None = None
        """The same, before it is compared with what other lasers say, and helped by it."""
        self.view: View | None = None
        self.witness: Witness | None = None
        self.costs_m: deque[float] = deque(maxlen=_COSTS)
        self.passes: list[Kept] = []
        """All that were closed, in their order, of the pole or of another reflector."""
        self.dropped: dict[int, Choice] = {}
        """Passes that the operator does not want, by id."""
        self._calibrated: list[Pass] = []
        self._config, self._laser, self._most = config, laser, config.routine.max_passes
        self._earlier_poles: set[tuple[int, int]] = set()
        self.anew(0, trajectory, gps_clock)

    def anew(self, site: int, trajectory: Trajectory, gps_clock: Clock) -> None:
        """Begin to listen anew, on another day; what was learnt of the pole's place is of no use."""
        self._site = site
        self._passing = Passing(site)
        self.pulse = Pulse()
        self.costs_m.clear()
        count = max((one.id for one in self.passes), default=0)
        self.channel = LaserChannel(
            *(self._laser, self._config, trajectory, gps_clock, self.pulse.beat),
            on_scan=self._on_scan,
            site=site,
            passes_before=count,
        )

    def remember(self, passes: Iterable[Kept], poles: Collection[tuple[int, int]]) -> None:
        """Take passes of earlier days, and which (site, place) of theirs could be the pole."""
        self.passes = [one.spilled(self._spill) for one in passes]
        self._earlier_poles = set(poles)

    def take(self, stored: StoredPass) -> None:
        self.passes.append(stored.kept.spilled(self._spill))
        self.estimate(everywhere=False)
        if self.result is not None:
            self.costs_m.append(round(self.result.cost_m, 5))

    def counted(self) -> list[Kept]:
        """Give the passes of the pole, less what was dropped."""
        poles = self.poles()
        return [one for one in self.passes if one.where in poles and one.id not in self.dropped]

    def estimate(self, *, everywhere: bool) -> None:
        """Calibrate on the passes of the pole, less what was dropped."""
        kept = self.counted()
        passes = [one.moments for one in kept]
        self._calibrated = passes
        self.alone = self.result = self.view = self.witness = None
        self.channel.mount = self.setup.measured
        if not passes:
            return  # what was thin from one side has turned out to be a plate, or all were dropped
        with suppress(CalibrationError):
            found = estimate(passes, self.setup, everywhere=everywhere)
            if not self.left:
                found = replace(found, verdict=given_up(found.verdict, self._most))
            self.alone = self.result = found
            if len(self._config.lasers) > 1:
                spans_ns = [one.facts.gps_ns for one in kept]
                self.view = View.of(self.name, passes, spans_ns, self.setup, self.result)
                self.witness = Witness(self.name, passes, spans_ns, self.setup, self.result)
            # One pass over level ground may put the laser anywhere; what is placed by that is lost.
            if self._could_be(self.result.mount):
                self.channel.mount = self.result.mount

    @property
    def left(self) -> int:
        """How many more passes there may be; those that were dropped count, too."""
        return max(0, self._most - most_of_one(self.passes))

    def passing(self) -> dict[str, Any] | None:
        """Tell of the pass of the pole that is being driven, None where there is none."""
        if self.result is None:
            return None
        places = {place for site, place in self.poles() if site == self._site}
        of_pole = [one for one in self.channel.open_passes if one.place in places]
        return self._passing.told(self._calibrated, self.setup, self.result, of_pole, self.channel.mount)

    def reflectors(self) -> dict[tuple[int, int], list[Kept]]:
        """Give the passes of each reflector that could be the pole, by (site, place)."""
        every: dict[tuple[int, int], list[Kept]] = {}
        for one in self.passes:
            every.setdefault(one.where, []).append(one)
        return {where: passes for where, passes in every.items() if self._could_be_pole(*where)}

    def poles(self) -> set[tuple[int, int]]:
        """Give the (site, place) of each day's pole: the thin reflector seen most evenly from all sides."""
        best: dict[int, tuple[int, tuple[int, int]]] = {}
        for where, passes in self.reflectors().items():
            progress = self._progress(one.moments for one in passes if one.id not in self.dropped)
            if where[0] not in best or progress > best[where[0]][0]:
                best[where[0]] = progress, where
        return {where for _, where in best.values()}

    def _could_be_pole(self, site: int, place: int) -> bool:
        if site == self._site:
            return self.channel.places.could_be_pole(place)
        return (site, place) in self._earlier_poles

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


class _Line:
    """A device's chunks, which wait until there may be a whole frame in them: most end within one."""

    def __init__(self, listener: Navigation | LaserChannel) -> None:
        self.unheard: list[tuple[bytes, int]] = []
        self.lacking = 0
        """How many bytes must come yet before there may be."""
        self._listener = listener

    def hear(self) -> bool:
        """Hand them on; say whether a frame ended in them."""
        framed = self._listener.feed(self.unheard)
        self.unheard.clear()
        self.lacking = self._listener.framer.lacking
        return framed


class Pipeline:
    """All that happens between the bytes and the verdict.

    ``session`` and ``created`` go into the calibration as they are. The callbacks are called from
    within `feed`. ``folder`` has room for what many passes would hold of memory, which is there no longer
    than the pipeline is.
    """

    def __init__(
        self,
        config: Config,
        *,
        session: str = "",
        created: str = "",
        folder: Path | None = None,
        on_pass: OnPass | None = None,
        on_transition: OnTransition | None = None,
        on_scan: OnScan | None = None,
        on_pose: OnPose | None = None,
    ) -> None:
        self.routine = Routine(self._on_transition)
        self._told = on_transition
        self._lines: dict[str, _Line] = {}
        """Of each device, while data is being taken."""
        self._settled_until_ns = 0
        """By then nothing happens but by a frame."""
        self._session, self._created = session, created
        self._on_pass = on_pass
        self._config = config
        self._need = config.routine
        self._on_pose = on_pose
        self._site = 0
        self._choices: list[Choice] = []
        self._reference_point: Any = None  # of a session that was reopened, as the next
        self._origin: Place | None = None
        self._navigation = Navigation(config.navigation, on_pose)
        begin = partial(_LaserRun, config, on_scan=on_scan, spill=Spill(folder))
        listened = self._navigation.trajectory, self._navigation.clock
        self._lasers = {laser.name: begin(laser, *listened) for laser in config.lasers}

    def begin(self, t_ns: int, past: Past | None = None) -> None:
        """Start the run at host time ``t_ns``; with the ``past`` of a session that goes on, on its passes.

        Clocks, navigation, reflectors' places and open passes are another day's: they begin anew.
        """
        if past is not None:
            self.routine.to(State.IDLE, t_ns, "its next day begins")
            self.remember(past)
            for laser in self._lasers.values():
                laser.estimate(everywhere=True)
            self._compare()
        self.routine.to(State.CONNECTING, t_ns, "asked to start")

    def remember(self, past: Past) -> None:
        """Take over what is known of earlier days, in place of all that is known so far."""
        self._site, self._reference_point, self._origin = past.site, None, None
        self._navigation = Navigation(self._config.navigation, self._on_pose)
        for name, laser in self._lasers.items():
            laser.remember(past.passes.get(name, []), past.poles.get(name, []))
            laser.dropped = {}
            laser.anew(past.site, self._navigation.trajectory, self._navigation.clock)
        self._choices = []
        for choice in past.choices:
            self._apply(choice)

    def past(self) -> Past:
        """Give what a next day of this session takes over."""
        lasers = self._lasers.items()
        return Past(
            site=self._site + 1,
            passes={name: list(laser.passes) for name, laser in lasers},
            poles={name: sorted(laser.reflectors()) for name, laser in lasers},
            choices=tuple(self._choices),
        )

    def reopen(self, past: Past, t_ns: int) -> None:
        """Stand where a session's last run ended, to look at its passes and to choose among them."""
        self.remember(past)
        self._site = past.site - 1  # no new day
        for laser in self._lasers.values():
            laser.estimate(everywhere=True)
        self._compare()
        if past.ended is not None:
            self._reference_point, self._origin = past.reference_point, past.origin
            self.routine.reopen(past.ended, t_ns)

    def feed(self, device: str, t_ns: int, data: bytes) -> None:
        """Take a chunk that was read from a device at host time ``t_ns`` (CLOCK_MONOTONIC ns).

        Once the run has ended, nothing changes any more.
        """
        line = self._lines.get(device)
        if line is None:
            return
        line.unheard.append((data, t_ns))
        line.lacking -= len(data)
        if line.lacking > 0 and t_ns <= self._settled_until_ns:
            return  # as with most chunks: nothing is there that was not before
        framed = line.hear()
        self._navigation.tick(t_ns)
        before = self.routine.state
        if before is not State.COLLECTING or self._navigation.lost:
            self._advance(t_ns)
        news = self.routine.state is not before
        for laser in self._lasers.values() if framed else ():
            for stored in laser.channel.fuse():
                self._take(laser, stored)
                news = True
        if news:  # a verdict changes with a pass, and counts while collecting
            self._conclude(t_ns)
        if self.routine.state is State.COLLECTING:
            self._settled_until_ns = self._navigation.lost_ns

    def _on_transition(self, t_ns: int, old: State, new: State, why: str) -> None:
        self._settled_until_ns = 0
        if new in ENDED:
            self._lines = {}
        elif old in ENDED:
            self._lines = {name: _Line(laser.channel) for name, laser in self._lasers.items()}
            self._lines[SPAN] = _Line(self._navigation)
        if self._told is not None:
            self._told(t_ns, old, new, why)

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
        self._judge(t_ns)

    def _judge(self, t_ns: int) -> None:
        apart = self._compare()
        reasons = [
            f"{laser.name}: {reason}"
            for laser in self._lasers.values()
            for reason in self._entry(laser)["verdict"]["reasons"]
            if reason not in apart
        ]
        reasons += apart
        state = State.REJECTED if reasons else State.ACCEPTED
        self.routine.to(state, t_ns, "; ".join(reasons) or "all criteria are met")

    def status(self, *, passing: bool = True) -> dict[str, Any]:
        """Give the part of STATUS that follows from the data; of a pass that is not over if ``passing``."""
        told = [{"passing": laser.passing()} if passing else {} for laser in self._lasers.values()]
        return {
            "state": str(self.routine.state),
            "lasers": [
                self._entry(laser) | more for laser, more in zip(self._lasers.values(), told, strict=True)
            ],
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

    def stand(self) -> Stand:
        """Give what a route depends on."""
        lasers = []
        for laser in self._lasers.values():
            kept = laser.counted()
            today = [one.moments for one in kept if one.moments.site == self._site]
            passes = [one.moments for one in kept]
            lasers.append(LaserStand(laser.name, laser.setup, laser.result, passes, today))
        knows = self.routine.running and not self._navigation.lost
        pose = self._navigation.trajectory.newest if knows else None
        return Stand(
            state=self.routine.state,
            next=self._next(),
            missing=self._missing(),
            lasers=lasers,
            origin=self._navigation.trajectory.origin or self._origin,
            here=None if pose is None else ((pose.lat_deg, pose.lon_deg, pose.height_m), pose.azimuth_deg),
        )

    def _origin_told(self) -> dict[str, float] | None:
        origin = self._navigation.trajectory.origin or self._origin
        return origin and dict(zip(("lat_deg", "lon_deg", "height_m"), origin, strict=True))

    def calibration(self) -> dict[str, Any] | None:
        """Give the content of ``calibration.yaml``, None before there is a result for every laser."""
        lasers = []
        for laser in self._lasers.values():
            if laser.result is None:
                return None
            lasers.append(
                results.calibration(laser.name, laser.setup, laser.result, self._session, self._created)
                | {"reference_point": self._reference_point or self._navigation.reference_point}
                | {"reflectors": rows.reflectors(laser.reflectors(), laser.poles())}
            )
        return {
            "state": str(self.routine.state),
            "lasers": lasers,
            "captures": self._site + 1,
            "origin": self._origin_told(),
            "choices": [choice.as_dict() for choice in self._choices],
        }

    @property
    def choices(self) -> Sequence[Choice]:
        """What was dropped and kept, in its order."""
        return self._choices

    def passes(self) -> list[dict[str, Any]]:
        """Give a row a pass, laser by laser: what it is, what it is worth, and whether it is used."""
        return [row for laser in self._lasers.values() for row in self._rows(laser)]

    def _rows(self, laser: _LaserRun) -> list[dict[str, Any]]:
        poles = laser.poles()
        aside = laser.result.set_aside if laser.result is not None else {}
        use = {one.id: rows.use_of(one, poles, laser.dropped, aside) for one in laser.passes}
        used = [use[one.id][0] == rows.USED for one in laser.passes]
        told = (
            residuals([one.moments for one in laser.passes], used, laser.setup, laser.result)
            if laser.result is not None
            else {}
        )
        return [rows.row(laser.name, one, *use[one.id], told.get(one.id)) for one in laser.passes]

    def choice(self, said: object, *, drop: bool, by: str, at: str) -> Choice:
        """Read which pass an operator means. Raises Refused where there is none, or nothing to do."""
        self.may_choose()
        name, number = parse_name(said, list(self._lasers))
        laser = self._lasers[name]
        found = next((one for one in laser.passes if one.id == number), None)
        if found is None:
            there = ", ".join(pass_name(name, one.id) for one in laser.passes) or "none yet"
            raise Refused(f"there is no pass {pass_name(name, number)}", f"there is {there}", Code.USAGE)
        if drop == (number in laser.dropped):
            already = laser.dropped.get(number)
            is_so = f"was dropped already, by {already.by}" if already else "is not dropped"
            raise Refused(f"pass {pass_name(name, number)} {is_so}", "see `polecal-field passes`", Code.USAGE)
        return Choice(name, number, drop, by, at, found.moments.site, found.t_ns)

    def may_choose(self) -> None:
        """Raise Refused where no pass can be dropped or kept."""
        if not self.routine.running and self.routine.state not in (State.ACCEPTED, State.REJECTED):
            raise Refused(
                f"nothing can be dropped or kept while the session is {self.routine.state}",
                GO_ON,
                Code.USAGE,
            )

    def choose(self, t_ns: int, choice: Choice) -> dict[str, Any]:
        """Drop or keep a pass at host time ``t_ns``, and calibrate again; give what changed.

        Also possible once the run has ended accepted or rejected, which it may then not stay. Raises
        Refused where it cannot be done; nothing has changed then.
        """
        self.may_choose()
        laser = self._lasers.get(choice.laser)
        if laser is None:
            raise Refused(
                f"there is no laser {choice.laser}", f"there is {', '.join(self._lasers)}", Code.USAGE
            )
        before, dropped, choices = self._standing(laser), dict(laser.dropped), list(self._choices)
        self._apply(choice)
        laser.estimate(everywhere=not self.routine.running)
        if self.routine.running:
            self._conclude(t_ns)
        elif laser.result is None:
            laser.dropped, self._choices = dropped, choices
            laser.estimate(everywhere=True)
            self._compare()
            raise Refused(
                f"without pass {choice.name} there is nothing left to calibrate from",
                "keep another one first, or drive more: `polecal-field start --continue`",
                Code.USAGE,
            )
        else:
            done = "dropped" if choice.drop else "kept"
            self.routine.to(State.CALIBRATING, t_ns, f"pass {choice.name} is {done}")
            self._judge(t_ns)
        return rows.change(choice, before, self._standing(laser))

    def _apply(self, choice: Choice) -> None:
        """Note a choice, and the pass that it means."""
        laser = self._lasers.get(choice.laser)
        if laser is None:
            return
        self._choices.append(choice)
        number = meant(choice, laser.passes)
        if number is None:
            return
        if choice.drop:
            laser.dropped[number] = choice
        else:
            laser.dropped.pop(number, None)

    def _standing(self, laser: _LaserRun) -> dict[str, Any]:
        return {"state": str(self.routine.state)} | self._entry(laser)

    def _advance(self, t_ns: int) -> None:
        state = self.routine.state
        if state is State.COLLECTING:
            if self._navigation.lost:
                why = "; ".join(self._navigation.why_not) or f"{name_of(self._navigation.ins_status)}"
                self.routine.to(State.ALIGNING, t_ns, f"no good navigation solution for 2 s: {why}")
        elif (
            state is State.CONNECTING
            and self._navigation.pulse.count
            and all(laser.pulse.count for laser in self._lasers.values())
        ):
            self.routine.to(State.ALIGNING, t_ns, "all devices stream")
        elif state is State.ALIGNING and self._navigation.ready:
            self.routine.to(State.COLLECTING, t_ns, "the navigation solution is good")

    def _take(self, laser: _LaserRun, stored: StoredPass) -> None:
        stored = replace(stored, quality=self._navigation.quality.over(*stored.facts.gps_ns))
        if self._on_pass is not None:
            self._on_pass(laser.name, stored)
        laser.take(stored)

    def _compare(self) -> tuple[str, ...]:
        """Accept no laser where two of them cannot both be right, and say which; else they help others."""
        apart = disagreements([laser.view for laser in self._lasers.values() if laser.view is not None])
        enough = all(laser.alone and laser.alone.verdict.accepted for laser in self._lasers.values())
        for laser in self._lasers.values():
            laser.result = laser.alone
            if apart and laser.alone is not None:
                verdict = laser.alone.verdict
                refused = Verdict(False, (*verdict.reasons, *apart), enough or verdict.hopeless)
                laser.result = replace(laser.alone, verdict=refused)
        if not apart:
            witnesses = [laser.witness for laser in self._lasers.values() if laser.witness is not None]
            for name, result in share(witnesses).items():
                self._lasers[name].result = result
        return apart

    def _conclude(self, t_ns: int) -> None:
        self._compare()
        if self.routine.state is not State.COLLECTING:
            return
        verdicts = [laser.result.verdict for laser in self._lasers.values() if laser.result is not None]
        if len(verdicts) == len(self._lasers) and all(verdict.accepted for verdict in verdicts):
            self.finish(t_ns, "the criteria are met")
        elif full := [laser.name for laser in self._lasers.values() if not laser.left]:
            self.finish(t_ns, f"{' and '.join(full)}: all {self._need.max_passes} passes that there may be")
        elif any(verdict.hopeless for verdict in verdicts):
            self.finish(t_ns, "more of the same driving would not help")

    def _entry(self, laser: _LaserRun) -> dict[str, Any]:
        dropped = {reason: count for reason, count in laser.channel.dropped.items() if count}
        return results.entry(laser.name, laser.setup, laser.result) | {
            "dropped": dropped,
            "dropped_passes": sorted(laser.dropped),
            "earlier_passes": sum(one.moments.site < self._site for one in laser.passes),
            "need": asdict(laser.setup.need),
            "costs_m": list(laser.costs_m),
        }

    def _next(self) -> str:
        match self.routine.state:
            case State.CONNECTING:
                return "wait: not all devices stream yet"
            case State.ALIGNING:
                return "drive until the navigation has aligned: straight, briskly, with a few turns"
            case State.COLLECTING:
                missing = self._missing()
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

    def _missing(self) -> frozenset[int]:
        return frozenset(
            part["slice"]
            for laser in self._lasers.values()
            for part in results.entry(laser.name, laser.setup, laser.result)["coverage"]
            if not part["done"]
        )

    def _to_know_more(self) -> str:
        """Say what would make better known what is not known well enough, if that is all that is missing."""
        for laser in self._lasers.values():
            if laser.result is not None and any("known to" in why for why in laser.result.verdict.reasons):
                return f"; {results.weakest(laser.setup, laser.result.covariance).drive}"
        return ""

    def _notes(self) -> list[str]:
        notes = self._navigation.why_not + self._navigation.notes if self.routine.running else []
        for laser in self._lasers.values():
            if self.routine.running and laser.left <= _FEW_LEFT:
                notes.append(f"{laser.name}: {laser.left} passes more, and the session ends as it is then")
            result = laser.result
            if result is None or not all(part.done for part in result.slices):
                continue  # most of it will be told by the passes that are still missing
            if set(result.held) - laser.setup.hold:
                weak = results.weakest(laser.setup, result.covariance)
                notes.append(f"{laser.name}: {weak.name} is held as measured; to free it: {weak.drive}")
            if "time_s" not in result.extras:
                notes.append(
                    f"{laser.name}: a time offset cannot be told from x: pass the pole in reverse, "
                    "or at another speed"
                )
        return notes
