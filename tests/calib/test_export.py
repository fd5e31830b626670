"""Each export, read back by code that is not ours, places a return where Eq. 2 does."""

import argparse
import csv
import json
import re
import shlex
import sys
import types

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import URDF

from polecal.calib import CalibrationError, Mount, Returns, points_nav
from polecal.calib.export import FORMATS, accepted, export

FLIP = np.array([1.0, -1.0, -1.0])
SIGMA = {"x_m": 0.004, "y_m": 0.004, "z_m": 0.011, "roll_deg": 0.01, "pitch_deg": 0.01, "yaw_deg": 0.02}
OTHERS = ("urdf", "ros2", "autoware", "snark", "libbot")


def content(*mounts, state="accepted", names=("front", "rear-left"), reasons=(), **more):
    """A ``calibration.yaml`` with these mounts."""
    lasers = [
        {
            "name": name,
            "estimate": mount.as_dict(),
            "sigma": SIGMA,
            "held": [],
            "cost_m": 0.03,
            "verdict": {"accepted": not reasons, "reasons": list(reasons)},
            "session": "20261122T031500Z-front",
            "created": "2026-11-22T03:15:00+00:00",
            **more,
        }
        for name, mount in zip(names, mounts, strict=False)
    ]
    return {"state": state, "lasers": lasers}


def urdf(text):
    """By ROS's own parser."""
    joint = URDF.from_xml_string(text.encode()).joints[-1]
    turn = Rotation.from_euler("xyz", joint.origin.rpy)
    return joint.parent, joint.child, turn, np.array(joint.origin.xyz), FLIP


def ros2(text):
    """Run as a launch file, its node's arguments as its program would take them."""
    launch, actions = types.ModuleType("launch"), types.ModuleType("launch_ros.actions")
    launch.LaunchDescription = list
    actions.Node = lambda **given: given
    known = {"launch": launch, "launch_ros": types.ModuleType("launch_ros"), "launch_ros.actions": actions}
    scope = {}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in known.items():
            patch.setitem(sys.modules, name, module)
        exec(text, scope)
        nodes = scope["generate_launch_description"]()
    commands = [line[2:] for line in text.splitlines() if line.startswith("# ros2 run ")]
    assert len(commands) == len(nodes)
    node, command = nodes[-1], shlex.split(commands[-1])
    assert command == ["ros2", "run", node["package"], node["executable"], *node["arguments"]]
    parser = argparse.ArgumentParser()
    for name in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        parser.add_argument(f"--{name}", type=float, required=True)
    parser.add_argument("--frame-id", required=True)
    parser.add_argument("--child-frame-id", required=True)
    given = parser.parse_args(node["arguments"])
    turn = Rotation.from_quat([given.qx, given.qy, given.qz, given.qw])
    return given.frame_id, given.child_frame_id, turn, np.array([given.x, given.y, given.z]), FLIP


def autoware(text):
    ((parent, children),) = yaml.safe_load(text).items()
    child, pose = list(children.items())[-1]
    turn = Rotation.from_euler("xyz", [pose[name] for name in ("roll", "pitch", "yaw")])
    return parent, child, turn, np.array([pose[name] for name in "xyz"]), FLIP


def snark(text):
    fields = re.search(r"fields: (\S+);", text)[1].split(",")
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    pose = list(csv.DictReader(rows, fieldnames=fields))[-1]
    turn = Rotation.from_euler("xyz", [float(pose[name]) for name in ("roll", "pitch", "yaw")])
    return "body", pose["name"], turn, np.array([float(pose[name]) for name in "xyz"]), np.ones(3)


def libbot(text):
    bare = re.sub(r"#.*", "", text)
    assert bare.count("{") == bare.count("}")
    child, parent, xyz, quat = re.findall(
        r'([\w-]+) \{\s+relative_to = "(\w+)";.*?translation = \[(.*?)\];\s+quat = \[(.*?)\];',
        bare,
        re.DOTALL,
    )[-1]
    w, x, y, z = map(float, quat.split(","))
    return parent, child, Rotation.from_quat([x, y, z, w]), np.array(list(map(float, xyz.split(",")))), FLIP


READERS = {"urdf": urdf, "ros2": ros2, "autoware": autoware, "snark": snark, "libbot": libbot}
FRAMES = {
    "urdf": ("base_link", "rear-left_laser"),
    "ros2": ("base_link", "rear-left_laser"),
    "autoware": ("sensor_kit_base_link", "rear-left_base_link"),
    "snark": ("body", "rear-left"),
    "libbot": ("body", "rear-left"),
}

angle = st.floats(-180.0, 180.0)
near = st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 0.1])
pitch = st.one_of(st.floats(-90.0, 90.0), near.map(lambda off: 90.0 - off), near.map(lambda off: off - 90.0))
mounts = st.builds(Mount, *[st.floats(-10.0, 10.0)] * 3, angle, pitch, angle)


@pytest.mark.parametrize("form", OTHERS)
@settings(max_examples=60, deadline=None)
@given(mount=mounts, range_m=st.floats(0.0, 80.0), bearing=st.floats(-1.6, 1.6), seed=st.integers(0, 999))
def test_a_return_goes_where_eq_2_puts_it(form, mount, range_m, bearing, seed):
    chance = np.random.default_rng(seed)
    position, rpy = chance.uniform(-50, 50, 3), chance.uniform(-np.pi, np.pi, 3)
    returns = Returns(
        np.array([range_m]),
        np.array([bearing]),
        position[None],
        rpy[None],
        np.zeros(1, np.uint8),
        np.zeros(1, np.int64),
    )
    wanted = points_nav(returns, mount)[0]
    other = Mount(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    parent, child, turn, origin, axes = READERS[form](export(content(other, mount), form))
    assert (parent, child) == FRAMES[form]
    beam = np.array([range_m * np.cos(bearing), range_m * np.sin(bearing), 0.0])
    in_body = axes * (turn.apply(axes * beam) + origin)
    found = Rotation.from_euler("ZYX", rpy[::-1]).apply(in_body) + position
    assert found == pytest.approx(wanted, abs=1e-6)


def test_the_papers_mount_by_hand():
    """Table IV: 0.36 m left and 1 m up, pitch down and yaw left turn their signs in axes that do."""
    _, _, turn, origin, _ = urdf(
        export(content(Mount(-0.029, -0.36, -0.996, -0.528, -8.182, -2.017)), "urdf")
    )
    assert origin == pytest.approx([-0.029, 0.36, 0.996])
    assert turn.as_euler("xyz", degrees=True) == pytest.approx([-0.528, 8.182, 2.017])


@pytest.mark.parametrize("form", OTHERS)
def test_it_says_axes_units_order_sigma_and_what_was_not_found(form):
    text = export(
        content(
            Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0),
            held=["z"],
            time_offset_s=0.012,
            extras={"range_m": {"value": -0.015, "sigma": 0.001}},
            reference_point="the IMU's centre",
        ),
        form,
    )
    for word in ("child", "parent", "x forward, y ", "units: m", "rotation: "):
        assert word in text
    for word in ("z 0.0110 m", "yaw 0.0200 deg"):
        assert word in text
    for word in ("held as measured by hand, not found: z", "+12.0 ms later", "-15.0 mm", "the IMU's centre"):
        assert word in text
    assert "20261122T031500Z-front" in text
    assert "REJECTED" not in text


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("state", ["rejected", "idle", "accepted"])
def test_what_was_not_accepted_says_so_before_anything_else_and_can_still_be_read(form, state):
    mount = Mount(0.1, -0.35, -1.0, 0.0, -8.0, 0.0)
    bad = content(mount, mount, state=state, reasons=["cost 0.120 m is above 0.050 m -- far"])
    assert not accepted(bad)
    text = export(bad, form)
    opening = ('<?xml version="1.0"?>', "{", '"warning": [')
    lines = [line for line in text.splitlines() if line.strip() not in opening]
    assert "REJECTED - DO NOT USE" in lines[0]
    assert "cost 0.120 m is above 0.050 m" in lines[1]
    if form in READERS:
        assert READERS[form](text)[3] * READERS[form](text)[4] == pytest.approx([0.1, -0.35, -1.0])
    else:
        assert yaml.safe_load(text)["lasers"] == bad["lasers"]


def test_yaml_and_json_are_the_calibration_itself():
    good = content(Mount(0.1, -0.35, -1.0, 0.0, -8.0, 0.0))
    assert accepted(good)
    assert yaml.safe_load(export(good, "yaml")) == good
    assert json.loads(export(good, "json")) == good


@pytest.mark.parametrize("form", ["urdf", "ros2", "autoware", "libbot"])
def test_the_bodys_frame_can_be_named(form):
    text = export(content(Mount(0.1, -0.35, -1.0, 0.0, -8.0, 0.0)), form, "ins_link")
    assert READERS[form](text)[0] == "ins_link"


@pytest.mark.parametrize("form", FORMATS)
def test_a_pose_that_is_not_finite_is_not_exported(form):
    with pytest.raises(CalibrationError, match="front: its pose is not finite"):
        export(content(Mount(0.1, float("nan"), -1.0, 0.0, -8.0, 0.0)), form)
