"""A calibration to the words of other systems: URDF, ROS 2, Autoware, snark, libbot; and YAML and JSON.

The paper's axes are x forward, y right, z down, of body and sensor alike. Where a system has y left and z up
(REP-103), both sides change: with S = diag(1, -1, -1) the rotation is S Csb S and the origin S r_b, so that
roll stays, pitch and yaw, y and z change their signs, and a bearing counts to the left. In every format the
transform takes a point of the sensor (child) to the body (parent), as Eq. 2 does.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from polecal.calib.geometry import Array
from polecal.calib.observations import KEYS, PARAMETERS, CalibrationError, Mount

Content = Mapping[str, Any]
"""What ``calibration.yaml`` holds."""

_FLIP = np.array([1.0, -1.0, -1.0])  # S
_FLU = "x forward, y left, z up (REP-103), of parent and child alike; a laser's angle counts to the left"
_FRD = "x forward, y right, z down, of parent and child alike; a laser's angle counts to the right"
_ORDER = "Rz(yaw) Ry(pitch) Rx(roll): about the parent's fixed axes, roll first, then pitch, then yaw"


def accepted(content: Content) -> bool:
    """Say whether the whole calibration was accepted: the run, and every laser in it."""
    return content.get("state") == "accepted" and all(
        laser["verdict"]["accepted"] for laser in content["lasers"]
    )


def export(content: Content, form: str, parent: str | None = None) -> str:
    """Write a calibration in one of `FORMATS`.

    ``parent`` is the name of the body's frame, where the format names one and its usual name is not wanted.
    What was not accepted says so in the text itself, first. Raises CalibrationError for numbers that are
    not finite.
    """
    for laser in content["lasers"]:
        if not np.isfinite([laser["estimate"][key] for key in KEYS]).all():
            raise CalibrationError(
                f"{laser['name']}: its pose is not finite", "replay the session's capture, and look at it"
            )
    return FORMATS[form](content, parent)


def warning(content: Content) -> list[str]:
    """Say loudly, and why, that a calibration was not accepted; nothing of one that was."""
    if accepted(content):
        return []
    reasons = [
        f"{laser['name']}: {reason}" for laser in content["lasers"] for reason in laser["verdict"]["reasons"]
    ]
    return [f"REJECTED - DO NOT USE: this calibration was not accepted ({content.get('state')})", *reasons]


def _about(content: Content, axes: str, units: str, rotation: str = _ORDER) -> list[str]:
    """Say what a reader must know, line by line; what was held and what else was found, too."""
    lines = warning(content)
    lines.append("transform: takes a point of the child (laser) to the parent (body)")
    lines += [f"axes: {axes}", f"units: {units}", f"rotation: {rotation}"]
    for laser in content["lasers"]:
        name, sigma = laser["name"], laser["sigma"]
        spread = ", ".join(
            f"{parameter} {sigma[key]:.4f} {'m' if key.endswith('_m') else 'deg'}"
            for parameter, key in zip(PARAMETERS, KEYS, strict=True)
        )
        lines.append(f"{name}: session {laser.get('session')} of {laser.get('created')}")
        lines.append(f"{name}: one sigma, in polecal's axes (x forward, y right, z down): {spread}")
        if laser["held"]:
            lines.append(f"{name}: held as measured by hand, not found: {', '.join(laser['held'])}")
        point = laser.get("reference_point") or "the point whose position the navigation reports"
        lines.append(f"{name}: the parent's origin is {point}")
        if late_s := laser.get("time_offset_s"):
            lines.append(f"{name}: measured {1000 * late_s:+.1f} ms later than its stamps say; not in here")
        if bias := laser.get("extras", {}).get("range_m"):
            lines.append(
                f"{name}: {1000 * bias['value']:+.1f} mm are missing from ranges to the tape; not in here"
            )
    return lines


def _yaml(content: Content, _: str | None) -> str:
    head = "".join(f"# {line}\n" for line in warning(content))
    return head + yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)


def _json(content: Content, _: str | None) -> str:
    told = warning(content)
    whole = {"warning": told, **content} if told else dict(content)
    return json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _urdf(content: Content, parent: str | None) -> str:
    parent = parent or "base_link"
    lines = ['<?xml version="1.0"?>']
    about = _about(content, _FLU, "m and rad")
    lines += [f"<!-- {line.replace('--', '- -').rstrip('-')} -->" for line in about]
    lines += ['<robot name="polecal">', f'  <link name="{parent}"/>']
    for name, xyz, rpy, _ in _lasers(content, _FLIP):
        lines += [
            f'  <link name="{name}_laser"/>',
            f'  <joint name="{name}_laser_joint" type="fixed">',
            f'    <parent link="{parent}"/>',
            f'    <child link="{name}_laser"/>',
            f'    <origin xyz="{_joined(xyz, " ")}" rpy="{_joined(rpy, " ")}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def _ros2(content: Content, parent: str | None) -> str:
    parent = parent or "base_link"
    about = _about(content, _FLU, "m; the rotation is a quaternion", "quaternion x y z w, child to parent")
    lines = [f"# {line}" for line in about]
    nodes = []
    for name, xyz, _, xyzw in _lasers(content, _FLIP):
        numbers = [*zip(("x", "y", "z"), xyz, strict=True), *zip(("qx", "qy", "qz", "qw"), xyzw, strict=True)]
        arguments = [part for key, value in numbers for part in (f"--{key}", _number(value))]
        arguments += ["--frame-id", parent, "--child-frame-id", f"{name}_laser"]
        lines.append(f"# ros2 run tf2_ros static_transform_publisher {' '.join(arguments)}")
        nodes += [
            "            Node(",
            '                package="tf2_ros",',
            '                executable="static_transform_publisher",',
            f'                name="{name.replace("-", "_")}_laser_pose",',
            f"                arguments={json.dumps(arguments)},",
            "            ),",
        ]
    return "\n".join(
        [
            *lines,
            "from launch import LaunchDescription",
            "from launch_ros.actions import Node",
            "",
            "",
            "def generate_launch_description():",
            "    return LaunchDescription(",
            "        [",
            *nodes,
            "        ]",
            "    )",
            "",
        ]
    )


def _autoware(content: Content, parent: str | None) -> str:
    parent = parent or "sensor_kit_base_link"
    about = [
        *_about(content, _FLU, "m and rad"),
        f"{parent} must be at that origin, or be joined to it",
    ]
    poses = {
        f"{name}_base_link": dict(
            zip(PARAMETERS, (float(_number(value)) for value in (*xyz, *rpy)), strict=True)
        )
        for name, xyz, rpy, _ in _lasers(content, _FLIP)
    }
    return "".join(f"# {line}\n" for line in about) + yaml.safe_dump({parent: poses}, sort_keys=False)


def _snark(content: Content, _: str | None) -> str:
    about = [
        *_about(content, _FRD, "m and rad"),
        "fields: x,y,z,roll,pitch,yaw,name; the first six are an offset for points-frame --from",
    ]
    rows = [f"{_joined((*xyz, *rpy), ',')},{name}" for name, xyz, rpy, _ in _lasers(content, np.ones(3))]
    return "".join(f"# {line}\n" for line in about) + "\n".join([*rows, ""])


def _libbot(content: Content, parent: str | None) -> str:
    about = _about(content, _FLU, "m; the rotation is a quaternion", "quaternion w x y z, child to parent")
    lines = [f"# {line}" for line in about]
    lines.append("coordinate_frames {")
    for name, xyz, rpy, xyzw in _lasers(content, _FLIP):
        lines += [
            f"  {name} {{",
            f'    relative_to = "{parent or "body"}";',
            "    history = 0;",
            '    update_channel = "";',
            "    initial_transform {",
            f"      translation = [ {_joined(xyz, ', ')} ];",
            f"      # rpy = [ {_joined(np.degrees(rpy), ', ')} ] deg is the same as",
            f"      quat = [ {_joined((xyzw[3], *xyzw[:3]), ', ')} ];",
            "    }",
            "  }",
        ]
    return "\n".join([*lines, "}", ""])


FORMATS: dict[str, Callable[[Content, str | None], str]] = {
    "yaml": _yaml,
    "json": _json,
    "urdf": _urdf,
    "ros2": _ros2,
    "autoware": _autoware,
    "snark": _snark,
    "libbot": _libbot,
}


def _lasers(content: Content, flip: Array) -> list[tuple[str, Array, Array, Array]]:
    """Give each laser's name, origin (m), roll pitch yaw (rad) and quaternion xyzw, in axes ``flip`` (3,)."""
    poses = []
    for laser in content["lasers"]:
        mount = Mount(**{key: laser["estimate"][key] for key in KEYS})
        turned = Rotation.from_matrix(flip[:, None] * mount.rotation * flip)
        rpy = mount.vector[3:] * flip  # det S = 1: an axis that turns round turns its angle round
        poses.append((laser["name"], mount.vector[:3] * flip, rpy, turned.as_quat(canonical=True)))
    return poses


def _joined(values: Array | tuple[float, ...], between: str) -> str:
    return between.join(map(_number, values))


def _number(value: float) -> str:
    return f"{round(float(value), 9) + 0.0:.9f}"  # a nanometre; + 0.0 as there is no -0
