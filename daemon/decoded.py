"""A capture's chunks to messages that robot tools show: scans, fixes, frames, clock, and each pass's cloud.

They are what the pipeline made of the chunks, which are played through it once more. In the capture they
are beside the chunks and have the same log time, CLOCK_MONOTONIC; the time within each is UTC.

| topic | schema | |
|---|---|---|
| /NAME/scan | foxglove.LaserScan | every scan of a laser; stamped with the mean time of its beams |
| /NAME/points/measured, …/calibrated | foxglove.PointCloud | a pass's pole and ground, by either mount |
| /span/fix | foxglove.LocationFix | 20 a second, and whether the pose is trusted |
| /tf | foxglove.FrameTransform | the body while its pose is trusted, 20 a second; each laser on it |
| /clock | polecal.Clock | what time it is, once a second |
| /pole_pass | polecal.PolePass | a pass in numbers |
"""

from __future__ import annotations

import json
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
import pymap3d
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from polecal.calib import Kind, Mount, Returns, cost, points_nav
from polecal.calib.geometry import roll_pitch_yaw, rotation
from polecal.daemon import config as configuration
from polecal.daemon import foxglove
from polecal.daemon.choices import name_of
from polecal.daemon.config import SPAN
from polecal.daemon.control import Refused
from polecal.daemon.passes import StoredPass
from polecal.daemon.pipeline import Pipeline
from polecal.daemon.recorder import Event, Record, RecorderError
from polecal.daemon.replay import play
from polecal.daemon.rows import OTHER
from polecal.daemon.sessions import read_calibration
from polecal.drivers.novatel_span import NavState
from polecal.drivers.sick_lms import Decoded, beam_ages_s

METADATA = "polecal.decoded"
"""The metadata record that says what the frames are, and which calibration the clouds are shown by."""

_POSE_NS = 50_000_000
_CLOCK_NS = 1_000_000_000
_NAMES = ("range_m", "bearing_rad", "position_m", "rpy_rad", "velocity_mps", "rate_radps", "kind")

_TIME = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer"},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
    "required": ["sec", "nsec"],
}
_COUNT = {"type": "integer", "minimum": 0}
_METRES = {"type": "number", "minimum": 0}
CLOCK = {
    "title": "polecal.Clock",
    "type": "object",
    "properties": {
        "host": _TIME | {"description": "CLOCK_MONOTONIC of the host: the clock of every log time"},
        "utc": _TIME | {"description": "the same moment in UTC, Unix time"},
        "gps": {"anyOf": [_TIME, {"type": "null"}], "description": "since 1980-01-06; null while not known"},
        "source": {
            "enum": ["receiver", "host"],
            "description": "what UTC is by; the host's was read once, when the session began",
        },
    },
    "required": ["host", "utc", "gps", "source"],
}
POLE_PASS = {
    "title": "polecal.PolePass",
    "type": "object",
    "properties": {
        "name": {"type": "string"},
        "laser": {"type": "string"},
        "id": {"type": "integer"},
        "place": {"type": "integer", "description": "which reflector it was: passes of one have the same"},
        "use": {"type": "string", "description": "used, set aside, dropped, or of another reflector"},
        "begin": _TIME | {"description": "UTC of its first return"},
        "end": _TIME | {"description": "UTC of its last return"},
        "heading_deg": {"type": "number"},
        "speed_mps": {"type": "number"},
        "direction": {"type": "string"},
        "nearest_m": _METRES | {"description": "the shortest range to the pole"},
        "returns": {
            "type": "object",
            "properties": {"pole": _COUNT, "ground": _COUNT},
            "required": ["pole", "ground"],
        },
        "slices": {"type": "array", "description": "returns by slice of platform yaw"},
        "measured_cost_m": _METRES
        | {"description": "√c of Eq. 7 of this pass alone, by the mount as measured"},
        "calibrated_cost_m": {
            "anyOf": [_METRES, {"type": "null"}],
            "description": "the same by the calibrated one; null where there is none",
        },
    },
    "required": [
        *("name", "laser", "id", "place", "use", "begin", "end", "heading_deg", "speed_mps", "direction"),
        *("nearest_m", "returns", "slices", "measured_cost_m", "calibrated_cost_m"),
    ],
}
"""What else PASSES tells of a pass is in it, too."""


@dataclass(frozen=True, slots=True)
class _Calibrated:
    """A mount that was found, and the offsets that were found with it."""

    mount: Mount
    time_s: float
    range_m: float

    @classmethod
    def of(cls, entry: dict[str, Any]) -> Self | None:
        """Take a laser's entry of STATUS or calibration.yaml."""
        if entry["estimate"] is None:
            return None
        extras = {name: found["value"] for name, found in entry["extras"].items()}
        return cls(Mount(**entry["estimate"]), extras.get("time_s", 0.0), extras.get("range_m", 0.0))

    def apply(self, returns: Returns) -> Returns:
        """Give returns at the pose, and with the range, that the calibration takes them to have."""
        assert returns.velocity_mps is not None
        assert returns.rate_radps is not None
        turned = (
            rotation(returns.rpy_rad) @ Rotation.from_rotvec(returns.rate_radps * self.time_s).as_matrix()
        )
        return replace(
            returns,
            range_m=returns.range_m + np.where(returns.kind == Kind.POLE, self.range_m, 0.0),
            position_m=returns.position_m + returns.velocity_mps * self.time_s,
            rpy_rad=roll_pitch_yaw(turned),
        )


class Decoder:
    """Takes a capture's items in their order, and writes what they mean into an MCAP file.

    Passes wait in a file without a name in ``folder``: their clouds are shown by a calibration that is known
    at the end only. It is the one of ``folder`` where there is one of this session, else what it comes to.
    """

    def __init__(self, metadata: dict[str, str], folder: Path, writer: Writer) -> None:
        """Begin with a capture's metadata. Raises RecorderError, ConfigError, OSError."""
        lacking = ", ".join(key for key in ("session", "created", "config") if key not in metadata)
        if lacking:
            raise RecorderError(f"the capture does not say its {lacking}", "it was not made by a session")
        self._config = configuration.loads(metadata["config"], "the capture's configuration")
        self._session, self._folder, self._writer = metadata["session"], folder, writer
        self._created_ns = round(datetime.fromisoformat(metadata["created"]).timestamp()) * 10**9
        self._channels = foxglove.Channels(writer)
        self._lasers = {laser.name: laser for laser in self._config.lasers}
        self._age_ns = {
            laser.name: round(
                1e9
                * beam_ages_s(
                    laser.fov_deg, laser.resolution_deg, round(laser.fov_deg / laser.resolution_deg) + 1
                ).mean()
            )
            for laser in self._config.lasers
        }
        self._pipeline = Pipeline(
            self._config,
            folder=folder,
            on_pass=self._keep,
            on_scan=self._scan,
            on_pose=self._pose,
        )
        self._origin: tuple[float, float, float] | None = None
        self._now_ns = self._pose_ns = 0
        self._first_ns: int | None = None
        self._clock_ns: int | None = None
        self._before: dict[str, int] = {}
        self._kept: list[tuple[str, StoredPass]] = []  # without returns, which are in the file, and sums
        self._returns: IO[bytes] = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - until closed

    @property
    def count(self) -> int:
        """How many messages were written."""
        return self._channels.count

    def close(self) -> None:
        """Let go of what waits."""
        self._returns.close()

    def take(self, item: Record | Event) -> None:
        """Write what came to be known by an item."""
        self._now_ns = item.t_ns
        if self._first_ns is None:
            self._first_ns = item.t_ns
        if isinstance(item, Event) and "past" in item.content:  # another day: its passes are numbered on
            told = item.content["past"]["passes"]
            self._before = {name: max(numbers, default=0) for name, numbers in told.items()}
        with suppress(Refused):  # of an earlier day's pass
            play(self._pipeline, item)
        if self._clock_ns is None or item.t_ns - self._clock_ns >= _CLOCK_NS:
            self._clock_ns = item.t_ns
            gps_ns = self._pipeline.gps_ns(item.t_ns)
            content = {
                "host": _time(item.t_ns),
                "utc": _time(self._utc_ns(item.t_ns)),
                "gps": None if gps_ns is None else _time(gps_ns),
                "source": "host" if gps_ns is None else "receiver",
            }
            self._channels.put_json("/clock", item.t_ns, CLOCK, content)

    def finish(self) -> None:
        """Write what is known at the end only: the lasers' frames, and the passes."""
        self._pipeline.finish(self._now_ns, "the capture ends here")
        state, entries = self._calibration()
        about = {"frames": foxglove.FRAMES, "state": state, "leap_s": str(foxglove.LEAP_S)}
        first_ns = self._first_ns or 0
        stamp_ns = self._utc_ns(first_ns)
        found: dict[str, _Calibrated | None] = {}
        for name, laser in self._lasers.items():
            found[name] = best = _Calibrated.of(entries[name]) if name in entries else None
            mounts = {"measured": Mount(**laser.mount.model_dump())}
            if best is not None:
                mounts["calibrated"] = best.mount
                about[f"{name}/calibrated"] = json.dumps(
                    {key: entries[name][key] for key in ("estimate", "sigma", "held", "extras", "verdict")}
                )
            for how, mount in mounts.items():
                self._channels.put("/tf", first_ns, foxglove.sensor_on_body(stamp_ns, f"{name}/{how}", mount))
            self._channels.put("/tf", first_ns, foxglove.same_frame(stamp_ns, f"{name}/{how}", name))
        self._returns.seek(0)
        rows = {(row["laser"], row["pass"]): row for row in self._pipeline.passes()}
        for name, stored in self._kept:
            self._write_pass(name, stored, rows[name, stored.id], found[name])
        self._writer.add_metadata(METADATA, about)

    def _calibration(self) -> tuple[str, dict[str, dict[str, Any]]]:
        """Give the state that the run came to, and each laser's entry."""
        said = read_calibration(self._folder)
        if said is not None and all(entry["session"] == self._session for entry in said["lasers"]):
            return said["state"], {entry["name"]: entry for entry in said["lasers"]}
        status = self._pipeline.status()
        return status["state"], {entry["name"]: entry for entry in status["lasers"]}

    def _scan(self, laser: str, stx_ns: int, scan: Decoded) -> None:
        stamp_ns = self._utc_ns(stx_ns - self._age_ns[laser])
        message = foxglove.laser_scan(stamp_ns, laser, self._lasers[laser].fov_deg, scan)
        self._channels.put(f"/{laser}/scan", self._now_ns, message)

    def _pose(self, pose: NavState, used: bool) -> None:
        place = (pose.lat_deg, pose.lon_deg, pose.height_m)
        if used and self._origin is None:
            self._origin = place  # as the trajectory's
        if not pose.good or 0 <= pose.gps_ns - self._pose_ns < _POSE_NS:
            return
        self._pose_ns = pose.gps_ns
        self._channels.put(f"/{SPAN}/fix", self._now_ns, foxglove.location_fix(pose, used=used))
        if used and self._origin is not None:
            ned_m = [float(value) for value in pymap3d.geodetic2ned(*place, *self._origin)]
            rpy_deg = (pose.roll_deg, pose.pitch_deg, pose.azimuth_deg)
            stamp_ns = foxglove.utc_ns(pose.gps_ns)
            self._channels.put("/tf", self._now_ns, foxglove.body_in_map(stamp_ns, ned_m, rpy_deg))

    def _keep(self, laser: str, stored: StoredPass) -> None:
        columns = [getattr(stored.returns, name) for name in _NAMES]
        np.save(self._returns, np.column_stack(columns))
        gps_ns = stored.gps_ns[[stored.gps_ns.argmin(), stored.gps_ns.argmax()]]
        bare = replace(stored.moments, totals={})
        left = replace(stored, returns=stored.returns[:0], gps_ns=gps_ns, blocks={}, moments=bare)
        self._kept.append((laser, left))

    def _write_pass(
        self, laser: str, stored: StoredPass, row: dict[str, Any], found: _Calibrated | None
    ) -> None:
        returns = _returns(np.load(self._returns), stored.id)
        measured = Mount(**self._lasers[laser].mount.model_dump())
        radius_m = self._config.pole.radius_m
        begin_ns, end_ns = (foxglove.utc_ns(int(gps_ns)) for gps_ns in stored.gps_ns)
        t_ns = stored.t_ns[1]
        number = stored.id + self._before.get(laser, 0)
        shown = {"measured": (returns, measured)}
        cost_m = None
        if found is not None:
            shifted = found.apply(returns)
            shown["calibrated"] = shifted, found.mount
            cost_m = cost(shifted, found.mount, radius_m)
        if row["use"] != OTHER:
            for how, (each, mount) in shown.items():
                cloud = foxglove.point_cloud(end_ns, points_nav(each, mount), each.kind)
                self._channels.put(f"/{laser}/points/{how}", t_ns, cloud)
        pole = returns.kind == Kind.POLE
        content = {key: value for key, value in row.items() if key not in ("pass", "gps_ns", "t_ns")} | {
            "name": name_of(laser, number),
            "id": number,
            "begin": _time(begin_ns),
            "end": _time(end_ns),
            "returns": {"pole": int(pole.sum()), "ground": int((~pole).sum())},
            "measured_cost_m": cost(returns, measured, radius_m),
            "calibrated_cost_m": cost_m,
        }
        self._channels.put_json("/pole_pass", t_ns, POLE_PASS, content)

    def _utc_ns(self, t_ns: int) -> int:
        """Give the UTC of a host time: by the receiver, or by the host's own clock until that is known."""
        gps_ns = self._pipeline.gps_ns(t_ns)
        if gps_ns is not None:
            return foxglove.utc_ns(gps_ns)
        return self._created_ns + t_ns - (self._first_ns or 0)


def _returns(table: np.ndarray[Any, np.dtype[np.float64]], pass_id: int) -> Returns:
    """Give the returns that were kept as columns."""
    widths = np.array([1, 1, 3, 3, 3, 3, 1])
    parts = np.split(table, np.cumsum(widths)[:-1], axis=1)
    values = {
        name: part[:, 0] if width == 1 else part
        for name, part, width in zip(_NAMES, parts, widths, strict=True)
    }
    kind = values.pop("kind").astype(np.uint8)
    return Returns(**values, kind=kind, pass_id=np.full(len(kind), pass_id))


def _time(ns: int) -> dict[str, int]:
    return {"sec": ns // 10**9, "nsec": ns % 10**9}
