"""Our arrays and frames to messages of Foxglove's schemas, which robot tools show as they are.

Theirs are the frames of REP 103: body and sensor x forward, y left, z up; the map x east, y north, z up. Ours
are forward, right, down, and north, east, down. All turning from ours to theirs is done here, so a bearing,
positive to our right, becomes an angle counterclockwise: its negative.

They are protobuf, as a beam without a range is NaN, which JSON has no number for. Stamps are UTC.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polecal.calib import Mount
from polecal.calib.geometry import Array, rotation
from polecal.drivers.novatel_span import NavState
from polecal.drivers.sick_lms import Decoded

MAP, BODY = "map", "body"
FRAMES = (
    "map: x east, y north, z up, about the first pose that was used; body, and each laser on it as measured "
    "(NAME/measured) and as calibrated (NAME/calibrated): x forward, y left, z up; NAME: the better known one"
)

LEAP_S = 18
"""By which UTC is behind GPS time, since 2017."""
_GPS_EPOCH_NS = 315_964_800 * 10**9  # 1980-01-06 as Unix time

_FLU = np.diag([1.0, -1.0, -1.0])  # of forward, right, down
_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # of north, east, down
_HERE = Pose(position=Vector3(), orientation=Quaternion(w=1.0))
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("kind", "u1")])
_GRAIN_M = 1 / 1024  # a return is no finer, and what is below it would not compress
_FIELDS = [
    PackedElementField(name=name, offset=4 * index, type=kind)
    for index, (name, kind) in enumerate(
        [*((axis, PackedElementField.FLOAT32) for axis in "xyz"), ("kind", PackedElementField.UINT8)]
    )
]


class Channels:
    """Puts messages into an MCAP file under their topics; a topic's channel comes with its first message."""

    def __init__(self, writer: Writer) -> None:
        self.count = 0
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def put(self, topic: str, t_ns: int, message: Message) -> None:
        """Write a message of one of Foxglove's schemas, with ``t_ns`` (CLOCK_MONOTONIC) as its log time."""
        if topic not in self._channels:
            name = message.DESCRIPTOR.full_name
            if name not in self._schemas:
                self._schemas[name] = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", self._schemas[name])
        self._write(topic, t_ns, message.SerializeToString())

    def put_json(self, topic: str, t_ns: int, schema: Mapping[str, Any], content: Mapping[str, Any]) -> None:
        """Write a message of a JSON schema of our own, named by its title."""
        if topic not in self._channels:
            text = json.dumps(schema).encode()
            known = self._writer.register_schema(schema["title"], "jsonschema", text)
            self._channels[topic] = self._writer.register_channel(topic, "json", known)
        self._write(topic, t_ns, json.dumps(content, allow_nan=False).encode())

    def _write(self, topic: str, t_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], t_ns, data, t_ns)
        self.count += 1


def utc_ns(gps_ns: int) -> int:
    """Give the Unix time in ns of a GPS time in ns since 1980-01-06."""
    return gps_ns + _GPS_EPOCH_NS - LEAP_S * 10**9


def laser_scan(stamp_ns: int, frame: str, fov_deg: float, scan: Decoded) -> LaserScan:
    """Give a scan over a field of view; NaN where a beam has no range."""
    half_rad = np.radians(fov_deg) / 2  # the first beam is the rightmost
    told = scan.reflectivity if not np.isnan(scan.reflectivity).all() else np.empty(0)
    return LaserScan(
        timestamp=_stamp(stamp_ns),
        frame_id=frame,
        pose=_HERE,
        start_angle=-half_rad,
        end_angle=half_rad,
        ranges=scan.ranges_m.tolist(),
        intensities=told.tolist(),
    )


def location_fix(pose: NavState, *, used: bool) -> LocationFix:
    """Give a pose's position, its covariance if its log tells it, and whether it was trusted."""
    known = pose.position_sigma_m is not None
    north, east, down = pose.position_sigma_m or (0.0, 0.0, 0.0)
    v_north, v_east, v_down = pose.velocity_ned_mps
    return LocationFix(
        timestamp=_stamp(utc_ns(pose.gps_ns)),
        frame_id=BODY,
        latitude=pose.lat_deg,
        longitude=pose.lon_deg,
        altitude=pose.height_m,
        position_covariance=np.diag([east**2, north**2, down**2]).ravel().tolist(),
        position_covariance_type=LocationFix.DIAGONAL_KNOWN if known else LocationFix.UNKNOWN,
        heading=np.radians(pose.azimuth_deg),
        velocity=Vector3(x=v_east, y=v_north, z=-v_down),
        metadata=[KeyValuePair(key="used", value=str(used).lower())],
    )


def body_in_map(stamp_ns: int, ned_m: Sequence[float], rpy_deg: Sequence[float]) -> FrameTransform:
    """Give where the body is, of its position and attitude in n."""
    turned = _ENU @ rotation(np.radians(rpy_deg)) @ _FLU
    return _transform(stamp_ns, MAP, BODY, _ENU @ np.asarray(ned_m), turned)


def sensor_on_body(stamp_ns: int, frame: str, mount: Mount) -> FrameTransform:
    """Give where a laser sits."""
    return _transform(stamp_ns, BODY, frame, _FLU @ mount.vector[:3], _FLU @ mount.rotation @ _FLU)


def same_frame(stamp_ns: int, parent: str, child: str) -> FrameTransform:
    """Give one frame another name."""
    return _transform(stamp_ns, parent, child, np.zeros(3), np.eye(3))


def point_cloud(stamp_ns: int, points_ned_m: Array, kind: NDArray[np.uint8]) -> PointCloud:
    """Give (N, 3) points of n, with the (N,) `Kind` of each, in the map."""
    packed = np.empty(len(kind), _POINT)
    for axis, values in zip("xyz", _ENU @ points_ned_m.T, strict=True):
        packed[axis] = np.round(values / _GRAIN_M) * _GRAIN_M
    packed["kind"] = kind
    return PointCloud(
        timestamp=_stamp(stamp_ns),
        frame_id=MAP,
        pose=_HERE,
        point_stride=_POINT.itemsize,
        fields=_FIELDS,
        data=packed.tobytes(),
    )


def _transform(stamp_ns: int, parent: str, child: str, offset_m: Array, turned: Array) -> FrameTransform:
    x, y, z = offset_m.tolist()
    qx, qy, qz, qw = Rotation.from_matrix(turned).as_quat(canonical=True).tolist()
    return FrameTransform(
        timestamp=_stamp(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )


def _stamp(unix_ns: int) -> Timestamp:
    return Timestamp(seconds=unix_ns // 10**9, nanos=unix_ns % 10**9)
