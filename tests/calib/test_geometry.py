import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from polecal.calib.geometry import roll_pitch_yaw, rotation, rotation_gradient, skew, wrap

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
