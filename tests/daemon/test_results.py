"""The keys of interface.md, and numbers that agree with one another."""

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from polecal.calib import Mount
from polecal.daemon import results

ENTRY = {
    "name",
    "passes",
    "coverage",
    "estimate",
    "sigma",
    "held",
    "cost_m",
    "measured_cost_m",
    "verdict",
}  # interface.md, STATUS
ADDED = {
    "frame",
    "quaternion_xyzw",
    "matrix",
    "covariance",
    "returns",
    "time_offset_s",
    "session",
    "created",
}  # interface.md, calibration.yaml
KEYS = {"x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"}


@pytest.fixture(scope="module")
def content(recorded):
    return recorded.played.pipeline.calibration()


@pytest.fixture(scope="module")
def laser(content):
    (laser,) = content["lasers"]
    return laser


@pytest.fixture(scope="module")
def early(settings):
    """A laser's part of STATUS before there is any pass."""
    config = settings()
    return results.entry("front", results.setup_of(config, config.lasers[0]), None)


def test_every_key_of_the_interface_is_there(content, laser, early):
    assert content["state"] == "accepted"
    assert laser.keys() >= ENTRY | ADDED
    assert early.keys() >= ENTRY
    for each in (laser, early):
        assert len(each["coverage"]) == 12
        assert [part["slice"] for part in each["coverage"]] == list(range(12))
        assert all(part.keys() == {"slice", "pole_returns", "passes", "done"} for part in each["coverage"])
        assert each["verdict"].keys() >= {"accepted", "reasons"}
    assert laser["estimate"].keys() == laser["sigma"].keys() == KEYS
    assert laser["frame"].keys() >= {"parent", "child", "rotation"}
    assert laser["returns"].keys() == {"pole", "ground"}


def test_a_run_that_has_ended_tells_whether_its_minimum_is_proven_to_be_the_lowest(laser, early):
    assert laser["lowest"]["proven"] is True
    assert 0 <= laser["lowest"]["lower_by"] < 0.005
    assert early["lowest"] is None


def test_before_a_pass_there_is_no_number_and_a_reason(early):
    assert early["estimate"] is early["sigma"] is early["cost_m"] is early["measured_cost_m"] is None
    assert early["passes"] == 0
    assert not early["verdict"]["accepted"]
    assert early["verdict"]["reasons"]
    assert not any(part["done"] for part in early["coverage"])


def test_angles_quaternion_and_matrix_are_one_rotation(laser):
    matrix = np.array(laser["matrix"])
    estimate = laser["estimate"]
    angles = [estimate[key] for key in ("yaw_deg", "pitch_deg", "roll_deg")]
    rotation = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    assert matrix[:3, :3] == pytest.approx(rotation, abs=1e-12)
    assert Rotation.from_quat(laser["quaternion_xyzw"]).as_matrix() == pytest.approx(rotation, abs=1e-12)
    assert matrix[:3, 3].tolist() == [estimate[key] for key in ("x_m", "y_m", "z_m")]
    assert matrix[3].tolist() == [0, 0, 0, 1]


def test_covariance_is_symmetric_and_has_the_sigmas_on_its_diagonal(laser):
    covariance = np.array(laser["covariance"])
    sigma = Mount(**laser["sigma"]).vector  # degrees to rad
    assert covariance == pytest.approx(covariance.T)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(sigma)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_counts_agree(laser):
    assert sum(part["pole_returns"] for part in laser["coverage"]) == laser["returns"]["pole"]
    assert laser["returns"]["ground"] > laser["returns"]["pole"] > 1000
    assert laser["passes"] >= 12


def test_it_goes_through_yaml_and_json_to_the_last_digit(content):
    assert yaml.safe_load(yaml.safe_dump(content, sort_keys=False, allow_unicode=True)) == content
    assert json.loads(json.dumps(content, allow_nan=False)) == content


def test_the_configuration_becomes_the_set_up(settings):
    config = settings(
        laser={"mount_sigma": {"xyz_m": 0.03, "rpy_deg": 2.0}, "hold": ["z", "roll"]},
        accept={
            "cost_m": 0.04,
            "improvement": 0.01,
            "left_out_m": 0.045,
            "doubling": 0.03,
            "mode": "any",
            "max_sigma": {"xy_m": 0.01, "z_m": 0.02, "roll_deg": 0.3, "pitch_deg": 0.4, "yaw_deg": 0.5},
        },
        routine={"slice_deg": 45, "min_pole_returns": 7, "min_passes": 2, "slices_needed": 5},
    )
    setup = results.setup_of(config, config.lasers[0])
    assert setup.measured == Mount(0.0, -0.35, -1.0, 0.0, -8.0, 0.0)
    assert setup.measured_sigma == Mount(0.03, 0.03, 0.03, 2.0, 2.0, 2.0)
    assert (setup.pole_radius_m, setup.hold) == (0.04, {"z", "roll"})
    assert (setup.criteria.cost_m, setup.criteria.improvement, setup.criteria.mode) == (0.04, 0.01, "any")
    assert (setup.criteria.left_out_m, setup.criteria.doubling) == (0.045, 0.03)
    assert setup.criteria.max_sigma[:3] == (0.01, 0.01, 0.02)
    assert np.degrees(setup.criteria.max_sigma[3:]) == pytest.approx([0.3, 0.4, 0.5])
    need = setup.need
    assert (need.slice_deg, need.min_pole_returns, need.min_passes, need.slices_needed) == (45, 7, 2, 5)
    early = results.entry("front", setup, None)
    assert (len(early["coverage"]), set(early["held"])) == (8, {"z", "roll"})
