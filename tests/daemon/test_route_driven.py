"""A vehicle that drives what ROUTE says, and nothing else, until its laser's calibration is accepted."""

from dataclasses import astuple

import numpy as np
import pytest

from polecal.calib import KEYS
from polecal.daemon import route
from polecal.daemon.config import SPAN
from polecal.daemon.routefile import geojson
from polecal.daemon.routine import State
from polecal.drivers.emulated.steer import lines
from polecal.drivers.emulated.virtual import Rig, play
from polecal.drivers.emulated.world import HAND_MEASURED, MountPose

HANDS = {
    "ahead": HAND_MEASURED,
    "behind": MountPose(-0.6, 0.2, -0.9, 0.0, -8.0, 180.0),
    "to the right": MountPose(0.1, 0.4, -1.0, 0.0, -8.0, 90.0),
}
LONGEST_S = 700.0
HALF_WIDTH_M = 0.6
ROOM = {"turn_radius_m": 3.0, "area_m": 15.0, "half_width_m": HALF_WIDTH_M}
OFF_M = (0.4, -0.5)  # what is known of the pole's place before it was seen


@pytest.mark.parametrize("run", [(1, "ahead"), (2, "ahead"), (3, "behind"), (4, "to the right")])
def test_a_vehicle_that_drives_by_the_routes_alone_comes_to_a_true_calibration(
    run, begun, settings, t0_ns, tell
):
    seed, looks = run
    hand = HANDS[looks]
    config = settings(laser={"mount": dict(zip(KEYS, astuple(hand), strict=True))})
    rig = Rig.steered(seed, t0_ns, hand)
    rig.stream(t0_ns)
    world, vehicle = rig.world, rig.world.trajectory
    lat, lon, _ = world.geodetic(np.array([[*np.add(world.pole_ne_m, OFF_M), 0.0]]))
    request = ROOM | {"pole": [float(lat[0]), float(lon[0])]}
    played = begun(config)
    routes = []
    devices = {"front": rig.laser, SPAN: rig.receiver}
    ask_ns = 0
    for device, t_ns, data in play(devices, start_ns=t0_ns, seconds=LONGEST_S, chunk_s=0.007, jitter_s=3e-4):
        played.feed([(device, t_ns, data)])
        if not played.pipeline.routine.running:
            break
        if played.state is not State.COLLECTING or t_ns < ask_ns:
            continue
        ask_ns = t_ns + 10**9
        unseen = bool(routes) and routes[-1]["pole"]["known"] == "given"
        if vehicle.idle or (unseen and played.passes):
            routes.append(route.answer(config, played.pipeline.stand(), request))
            assert routes[-1]["legs"], routes[-1]["why"]
            vehicle.follow(lines(geojson(routes[-1]), world.local))

    laser = played.laser()
    off = np.array([laser["estimate"][key] - getattr(world.mount, key) for key in KEYS])
    off[3:] = (off[3:] + 180) % 360 - 180
    sigmas = np.abs(off) / [laser["sigma"][key] for key in KEYS]
    from_pole_m = np.hypot(*(vehicle.path_m - world.pole_ne_m).T)
    tell(
        f"{looks}, seed {seed}: {played.state} after {(played.last_ns - t0_ns) / 1e9:.0f} s, "
        f"{laser['passes']} passes, {len(routes)} routes; from the pole {from_pole_m.min():.2f} to "
        f"{from_pole_m.max():.1f} m; off by {np.round(sigmas, 1)} σ"
    )
    assert played.state is State.ACCEPTED, laser["verdict"]
    assert routes[0]["pole"]["known"] == "given"
    assert all(told["pole"]["known"] == "seen" for told in routes[1:])
    free = [name not in laser["held"] for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert sigmas[free].max() < 3.0
    assert np.median(sigmas[free]) < 1.5
    assert "time_s" in laser["extras"]
    directions = {one.facts.direction for _, one in played.passes}
    assert {"forward", "reverse"} <= directions or "both" in directions
    assert from_pole_m.min() > HALF_WIDTH_M + 0.2
    assert from_pole_m.max() < ROOM["area_m"] + 1.0
