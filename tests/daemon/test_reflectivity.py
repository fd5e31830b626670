"""A calibration from each way in which a laser can tell reflectivity: levels, energy, S14."""

import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.virtual import STREAM_LOGS, play
from polecal.drivers.emulated.world import demo_world

SECOND = 10**9
DRIVE_S = 45.0  # the first passes of the demonstration's drive
STREAM, ENERGIES, BYTES = "20 24", "20 2B 0100 0100 6500", "20 50 0100 B500"
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")


def configuration(mode):
    """77h: the factory's configuration with this measuring mode, in cm, and real-time indices on."""
    return b"\x77" + lms.STREAM_CONFIG[: lms.MEASURING_MODE] + bytes([mode]) + lms.STREAM_CONFIG[lms.UNIT :]


def set_variant(fov_deg, resolution_deg):
    return b"\x3b" + fov_deg.to_bytes(2, "little") + round(resolution_deg * 100).to_bytes(2, "little")


def heard(world, kind, t0_ns, measuring_mode, variant, mode):  # noqa: PLR0917
    """What a host hears that has set its laser up by these telegrams."""
    laser = EmulatedLaser(world, t0_ns=t0_ns - 20 * SECOND, seed=1, type_string=f"LMS291;{kind};V02.10 ")
    span = EmulatedReceiver(world, t0_ns=t0_ns, seed=1)
    said = (
        b"\x20\x00" + lms.PASSWORD, configuration(measuring_mode), b"\x20\x25",
        set_variant(*variant), b"\x20\x48", bytes.fromhex(mode),
    )  # fmt: skip
    for at_s, payload in enumerate(said, start=1 - len(said)):
        t_ns = t0_ns + at_s * SECOND
        laser.transmit(t_ns, laser.baud)  # its answer to the one before
        laser.receive(t_ns, lms.telegram(0, payload), laser.baud)
    span.force_logs(t0_ns, STREAM_LOGS)
    devices = {"front": laser, "span": span}
    return play(devices, start_ns=t0_ns, seconds=DRIVE_S, chunk_s=0.013, jitter_s=3e-4)


@pytest.mark.parametrize(
    ("wanted", "kind", "measuring_mode", "fov_deg", "resolution_deg", "mode"),
    [
        ("energy", "S05", 0x0E, 100, 1, ENERGIES),
        ("energy", "S05", 0x01, 100, 1, STREAM),
        ("s14", "S14", 0x01, 90, 0.5, BYTES),
    ],
    ids=["energy", "energy that fell back to levels", "s14"],
)
def test_it_finds_the_true_pose(  # noqa: PLR0917
    settings, begun, t0_ns, wanted, kind, measuring_mode, fov_deg, resolution_deg, mode
):
    world = demo_world(1)
    config = settings({"fov_deg": fov_deg, "resolution_deg": resolution_deg, "reflectivity": wanted})
    played = begun(config)
    chunks = heard(world, kind, t0_ns, measuring_mode, (fov_deg, resolution_deg), mode)
    played.feed(chunks).finish()
    laser = played.laser()
    off = {key: laser["estimate"][key] - getattr(world.mount, key) for key in laser["estimate"]}
    assert max(abs(off[key]) for key in ANGLES) <= 0.1
    assert max(abs(off[key]) for key in ("x_m", "y_m")) <= 0.015
    assert all(abs(off[key]) <= 3 * laser["sigma"][key] for key in off)
