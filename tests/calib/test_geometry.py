import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from polecal.calib.geometry import (
    ICOSAHEDRAL,
    quaternion_xyzw,
    roll_pitch_yaw,
    rotation,
    rotation_gradient,
    skew,
    turning,
    wrap,
)

angles = st.floats(-1.5, 1.5)


def test_each_angle_turns_the_way_the_paper_says():
    up_front = rotation(np.array([0.0, 0.1, 0.0])) @ [1.0, 0.0, 0.0]
    assert up_front[2] < 0, "positive pitch lifts the nose: z is down"
    right_side = rotation(np.array([0.1, 0.0, 0.0])) @ [0.0, 1.0, 0.0]
    assert right_side[2] > 0, "positive roll lowers the right side"
    nose = rotation(np.array([0.0, 0.0, np.pi / 2])) @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(nose, [0.0, 1.0, 0.0], atol=1e-15)


def test_a_vehicle_heading_east_pitched_and_rolled_points_as_the_span_sheet_says():
    c = rotation(np.radians([3.0, 5.0, 90.0]))
    east_north_up = c[[1, 0, 2]] * [[1], [1], [-1]]
    np.testing.assert_allclose(east_north_up[:, 0], [0.99619, 0.0, 0.08716], atol=1e-5)
    np.testing.assert_allclose(east_north_up[:, 1], [0.00456, -0.99863, -0.05214], atol=1e-5)


@given(angles, angles, st.floats(-3.1, 3.1))
def test_angles_come_back_from_their_rotation(roll, pitch, yaw):
    rpy = np.array([roll, pitch, yaw])
    np.testing.assert_allclose(roll_pitch_yaw(rotation(rpy)), rpy, atol=1e-9)


@given(angles, angles, angles)
def test_gradient_is_that_of_finite_differences(roll, pitch, yaw):
    rpy, step = np.array([roll, pitch, yaw]), 1e-6
    for axis in range(3):
        d = step * np.eye(3)[axis]
        difference = (rotation(rpy + d) - rotation(rpy - d)) / (2 * step)
        np.testing.assert_allclose(rotation_gradient(rpy)[axis], difference, atol=1e-8)


def test_skew_crosses():
    a, b = np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.5, 4.0])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))


@pytest.mark.parametrize(("angle", "wrapped"), [(3 * np.pi / 2, -np.pi / 2), (-np.pi, -np.pi), (0.1, 0.1)])
def test_wrap_takes_the_short_way(angle, wrapped):
    assert wrap(np.array([angle]))[0] == pytest.approx(wrapped)


@given(st.tuples(*[st.floats(-7, 7)] * 3))
def test_turning_and_its_quaternion_are_those_of_scipy(vector):
    theirs = Rotation.from_rotvec(vector)
    np.testing.assert_allclose(turning(np.array(vector)), theirs.as_matrix(), atol=1e-14)
    ours = quaternion_xyzw(theirs.as_matrix())
    assert abs(ours @ theirs.as_quat()) == pytest.approx(1.0, abs=1e-14)
    assert ours[3] >= 0


@pytest.mark.parametrize("axis", range(3))
def test_half_a_turn_has_a_quaternion_too(axis):
    about = np.pi * np.eye(3)[axis]
    np.testing.assert_allclose(np.abs(quaternion_xyzw(turning(about))), np.eye(4)[axis], atol=1e-15)


def test_an_icosahedrons_rotations_are_a_group_of_60_evenly_apart():
    every = ICOSAHEDRAL.reshape(60, 9)
    np.testing.assert_allclose(
        ICOSAHEDRAL @ ICOSAHEDRAL.swapaxes(1, 2), np.tile(np.eye(3), (60, 1, 1)), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(ICOSAHEDRAL), 1.0)
    products = (ICOSAHEDRAL[:, None] @ ICOSAHEDRAL).reshape(3600, 1, 9)
    assert (np.abs(products - every).max(axis=2).min(axis=1) < 1e-12).all()
    apart = np.abs(every[:, None] - every).max(axis=2) + np.eye(60)
    assert apart.min() > 0.1
