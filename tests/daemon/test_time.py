"""One time for two devices: what the clocks, the beams' own times and the time offset are worth."""

from dataclasses import astuple

import numpy as np
import pytest
import yaml

from polecal.daemon.config import SPAN, loads
from polecal.daemon.pipeline import Pipeline
from polecal.drivers.emulated.laser import EmulatedLaser
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.virtual import STREAM_LOGS, play
from polecal.drivers.emulated.world import demo_world

T0_NS = 10**12
MEASURED = {"x_m": 0.0, "y_m": -0.35, "z_m": -1.0, "roll_deg": 0.0, "pitch_deg": -8.0, "yaw_deg": 0.0}
CONFIG = {
    "lasers": [
        {
            "name": "front",
            "port": "/dev/lms",
            "mount": {
                "x_m": 0.0,
                "y_m": -0.35,
                "z_m": -1.0,
                "roll_deg": 0.0,
                "pitch_deg": -8.0,
                "yaw_deg": 0.0,
            },
        }
    ],
    "navigation": {"port": "/dev/span"},
    "pole": {"radius_m": 0.04, "height_m": 2.4},
    "routine": {"min_pole_returns": 60},
}


class Faster:
    """The demonstration's drive and its navigation errors, so many times as fast."""

    def __init__(self, of, times):
        self._of, self._times = of, times

    def pose(self, t_s):
        position, rpy, velocity = self._of.pose(np.asarray(t_s) * self._times)
        return position, rpy, velocity * self._times

    def at(self, t_s):
        return self._of.at(np.asarray(t_s) * self._times)


def run(
    *,
    delay_s=0.0,
    one_stamp=False,
    usb_s=0.002,
    seconds=80.0,
    after=lambda chunks: chunks,
    seed=2,
    indices=True,
):
    """The pipeline's laser at 5 m/s, of a world whose laser's bytes all come ``delay_s`` late."""
    world = demo_world(seed)
    world.trajectory, world.nav_error = Faster(world.trajectory, 1.75), Faster(world.nav_error, 1.75)
    laser = EmulatedLaser(world, t0_ns=T0_NS, seed=1, drift_ppm=50.0)
    receiver = EmulatedReceiver(world, t0_ns=T0_NS, seed=1, drift_ppm=-50.0)
    laser.force_stream(T0_NS)
    if not indices:
        laser._state.config = without_indices(laser._state.config)
    receiver.force_logs(T0_NS, STREAM_LOGS)
    pipeline = Pipeline(loads(yaml.safe_dump(CONFIG)))
    pipeline.begin(T0_NS)
    channel = pipeline._lasers["front"].channel
    if one_stamp:
        channel._age_ns = np.full_like(channel._age_ns, int(channel._age_ns.mean()))
    devices = {"front": laser, SPAN: receiver}
    chunks = [
        (t_ns + (round(delay_s * 1e9) if name == "front" else 0), name, data)
        for name, t_ns, data in play(devices, start_ns=T0_NS, seconds=seconds, chunk_s=usb_s)
    ]
    t_ns = T0_NS
    for t_ns, name, data in after(sorted(chunks, key=lambda chunk: chunk[0])):
        pipeline.feed(name, t_ns, data)
    pipeline.finish(t_ns, "the drive is over")
    result = pipeline._lasers["front"].result
    return result, np.abs(np.subtract(astuple(result.mount), astuple(world.mount)))


def without_indices(config):
    """The same configuration, availability bit 1 (sheet, 3.2) off."""
    return config[:4] + bytes([config[4] & ~0x02]) + config[5:]


@pytest.fixture(scope="module")
def prompt():
    return run()


def test_an_unknown_delay_of_the_laser_is_found_and_costs_nothing(prompt, tell):
    undelayed, its_error = prompt
    result, error = run(delay_s=0.040)
    one_stamp, _ = run(delay_s=0.040, one_stamp=True)
    found_ms = -1e3 * (result.extras["time_s"] - undelayed.extras["time_s"])
    tell(f"40 ms late, 5 m/s: found {found_ms:.2f} ms")
    tell(f"x y z m, roll pitch yaw ° off: {np.round(error, 4)}; without delay {np.round(its_error, 4)}")
    tell(f"√c {result.cost_m:.3f} m; with one timestamp a scan {one_stamp.cost_m:.3f} m")
    assert result.extras["time_s"] - undelayed.extras["time_s"] == pytest.approx(-0.040, abs=0.002)
    assert result.extra_sigma["time_s"] < 0.001
    free = np.array([name not in result.held for name in ("x", "y", "z", "roll", "pitch", "yaw")])
    assert (error - its_error)[free][:2].max() < 0.004
    assert (error - its_error)[3:].max() < 0.04
    assert one_stamp.cost_m > 2 * result.cost_m


def test_a_usb_adapter_that_hands_on_every_16_ms_costs_little(prompt):
    result, error = run(usb_s=0.016)
    assert error[:2].max() < 0.015
    assert error[3:].max() < 0.08
    assert abs(result.extras["time_s"] - prompt[0].extras["time_s"]) < 0.003


def test_a_laser_that_does_not_number_its_revolutions_is_counted_by_its_arrivals(prompt):
    rng = np.random.default_rng(5)
    lossy = lambda chunks: (chunk for chunk in chunks if rng.random() > 0.002)  # noqa: E731
    result, error = run(usb_s=0.008, indices=False, after=lossy)
    assert error[:2].max() < 0.015
    assert error[3:].max() < 0.08
    assert result.cost_m < 1.1 * prompt[0].cost_m


def test_lost_telegrams_and_a_laser_that_restarts_misplace_nothing():
    rng = np.random.default_rng(3)

    def spoilt(chunks):
        for t_ns, name, data in chunks:
            lost = rng.random() < 0.01
            silent = name == "front" and 30 < (t_ns - T0_NS) / 1e9 < 38
            if not lost and not silent:
                yield t_ns, name, data

    result, error = run(after=spoilt)
    assert error[:2].max() < 0.015
    assert error[3:].max() < 0.08
    assert result.cost_m < 0.05
