"""An emulated laser on the path that a real receiver recorded."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from polecal.daemon.config import Config, loads
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import PlaybackReceiver, load_recording, recorded_path
from polecal.drivers.emulated.world import MountPose, World

DRIVEN = "span_driver_ins_ppp_driven_20hz.bin"
UNALIGNED = "span_driver_basic_fix_unaligned_10hz.bin"
TRUE = MountPose(0.04, -0.31, -1.03, 0.7, -8.9, 1.9)
POLE_NE_M = (3.25, -0.75)
BAUD = 921600
_POSE_BYTES = 158  # an INSPVAXB, the last of its epoch


@dataclass
class DrivenRig:
    """The recorded receiver, and a laser that stands on the path it recorded."""

    laser: EmulatedLaser
    receiver: PlaybackReceiver
    seconds: float
    true: MountPose = TRUE


def driven_rig(path: Path, t0_ns: int) -> DrivenRig:
    """Both devices, just powered up; the recording and its path begin once a log is asked for.

    The recording has no line: a chunk is there at once when it was received over the network. On a serial
    line its bytes take their time, which the host takes off, so the path is laid that much earlier.
    """
    data, offsets, arrival_s = load_recording(path)
    trajectory, reference = recorded_path(data, offsets, arrival_s)
    trajectory.t_s = trajectory.t_s - _POSE_BYTES * 10 / BAUD
    world = World(trajectory, mount=TRUE, pole_ne_m=POLE_NE_M, reference=reference, seed=1)
    return DrivenRig(
        laser=EmulatedLaser(world, t0_ns=t0_ns, seed=1, starts_world=False),
        receiver=PlaybackReceiver(data, offsets, arrival_s, t0_ns=t0_ns, baud=BAUD, on_start=world.start),
        seconds=arrival_s[-1] - arrival_s[0],
    )


@pytest.fixture
def config(tmp_path: Path) -> Config:
    """The paper's hand-measured mount; fewer returns in a slice than usual, as the drive is short."""
    mount = {"x_m": 0.0, "y_m": -0.35, "z_m": -1.0, "roll_deg": 0.0, "pitch_deg": -8.0, "yaw_deg": 0.0}
    return loads(
        yaml.safe_dump(
            {
                "state_dir": str(tmp_path / "state"),
                "runtime_dir": str(tmp_path / "run"),
                "lasers": [{"name": "front", "port": str(tmp_path / "lms"), "mount": mount}],
                "navigation": {"port": str(tmp_path / "span"), "baud": BAUD, "rate_hz": 20},
                "pole": {"radius_m": 0.04, "height_m": 2.4},
                "routine": {"min_pole_returns": 30},
            }
        )
    )
