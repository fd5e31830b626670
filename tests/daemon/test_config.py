"""A configuration is taken whole and right, or refused with every fault named."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from polecal.daemon import config
from polecal.daemon.config import ConfigError

MOUNT = "{x_m: 0, y_m: -0.35, z_m: -1.0, roll_deg: 0.0, pitch_deg: -8.0, yaw_deg: 0.0}"
LEAST = f"""
lasers:
  - port: /dev/lms
    mount: {MOUNT}
navigation: {{port: /dev/span}}
pole: {{radius_m: 0.04, height_m: 2.4}}
"""


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        config.loads(text)
    assert all(fault in str(caught.value) for fault in caught.value.faults)
    assert caught.value.hint
    return caught.value.faults


def paths(text: str) -> list[str]:
    return [fault.split(": ")[0] for fault in faults(text)]


def test_only_ports_mount_and_pole_are_needed():
    loaded = config.loads(LEAST)
    laser = loaded.lasers[0]
    assert loaded.state_dir == Path("/var/lib/polecal")
    assert loaded.socket == Path("/run/polecal/control.sock")
    assert (laser.name, laser.baud, laser.fov_deg, laser.resolution_deg) == ("front", 500000, 100, 0.25)
    assert (laser.reflectivity, laser.hold) == ("levels", ())
    assert (laser.mount_sigma.xyz_m, laser.mount_sigma.rpy_deg) == (0.1, 5.0)
    assert (loaded.navigation.baud, loaded.navigation.rate_hz) == (230400, 100)
    assert (loaded.routine.slice_deg, loaded.routine.slices_needed) == (30, 12)
    assert (loaded.routine.min_pole_returns, loaded.routine.min_passes) == (100, 1)
    assert loaded.routine.max_passes == 200
    assert (loaded.accept.cost_m, loaded.accept.improvement, loaded.accept.mode) == (0.05, 0.02, "all")
    assert (loaded.accept.max_sigma.xy_m, loaded.accept.max_sigma.yaw_deg) == (0.02, 0.1)


def test_each_thing_without_a_default_is_missed():
    assert faults("lasers: [{}]\nnavigation: {}\npole: {}") == [
        "lasers[0].port: is missing",
        "lasers[0].mount: is missing",
        "navigation.port: is missing",
        "pole.radius_m: is missing",
        "pole.height_m: is missing",
    ]


def test_all_faults_come_at_once_each_with_its_path():
    text = LEAST.replace("/dev/span", "/dev/span, rate: 50").replace("0.04", "-0.04").replace("x_m: 0, ", "")
    assert faults(text) == [
        "lasers[0].mount.x_m: is missing",
        "navigation.rate: is not a key that polecal knows",
        "pole.radius_m: must be greater than 0, not -0.04",
    ]


@pytest.mark.parametrize(
    ("change", "to", "path"),
    [
        ("port: /dev/lms", "port: ''", "lasers[0].port"),
        ("port: /dev/lms", "port: /dev/lms\n    name: span", "lasers[0].name"),
        ("port: /dev/lms", "port: /dev/lms\n    name: Front Left", "lasers[0].name"),
        ("port: /dev/lms", "port: /dev/lms\n    baud: 115200", "lasers[0].baud"),
        ("port: /dev/lms", "port: /dev/lms\n    fov_deg: 180", "lasers[0].resolution_deg"),
        ("port: /dev/lms", "port: /dev/lms\n    fov_deg: 120", "lasers[0].fov_deg"),
        ("port: /dev/lms", "port: /dev/lms\n    resolution_deg: 0.3", "lasers[0].resolution_deg"),
        (
            "port: /dev/lms",
            "port: /dev/lms\n    fov_deg: 90\n    resolution_deg: 0.5",
            "lasers[0].reflectivity",
        ),
        ("port: /dev/lms", "port: /dev/lms\n    hold: [z, height]", "lasers[0].hold[1]"),
        ("port: /dev/lms", "port: /dev/lms\n    hold: [z, z]", "lasers[0].hold"),
        ("port: /dev/lms", "port: /dev/lms\n    mount_sigma: {xyz_m: 0}", "lasers[0].mount_sigma.xyz_m"),
        ("y_m: -0.35", "y_m: .nan", "lasers[0].mount.y_m"),
        ("y_m: -0.35", "y_m: .inf", "lasers[0].mount.y_m"),
        ("y_m: -0.35", "y_m: '-0.35'", "lasers[0].mount.y_m"),
        ("y_m: -0.35", "y_m: true", "lasers[0].mount.y_m"),
        ("y_m: -0.35", "y_m: -350", "lasers[0].mount.y_m"),
        ("port: /dev/span", "port: /dev/lms", "navigation.port"),
        ("port: /dev/span", "port: /dev/span, rate_hz: 25", "navigation.rate_hz"),
        ("port: /dev/span", "port: /dev/span, baud: 57600", "navigation.rate_hz"),
        ("port: /dev/span", "port: /dev/span, baud: 500000", "navigation.baud"),
        ("port: /dev/span", "port: /dev/span, position_types: [INS_RTK]", "navigation.position_types"),
        ("port: /dev/span", "port: /dev/span, position_types: []", "navigation.position_types"),
        ("port: /dev/span", "port: /dev/span, time_status: [GOOD]", "navigation.time_status"),
        ("port: /dev/span", "port: /dev/span, max_sigma: {height_m: 0}", "navigation.max_sigma.height_m"),
        ("port: /dev/span", "port: /dev/span, max_off_course_deg: 91", "navigation.max_off_course_deg"),
        ("pole:", "routine: {slice_deg: 50}\npole:", "routine.slice_deg"),
        ("pole:", "routine: {slice_deg: 45}\npole:", "routine.slices_needed"),
        ("pole:", "routine: {min_passes: 0}\npole:", "routine.min_passes"),
        ("pole:", "routine: {min_passes: 9, max_passes: 8}\npole:", "routine.max_passes"),
        ("pole:", "routine: {max_passes: 501}\npole:", "routine.max_passes"),
        ("pole:", "accept: {mode: most}\npole:", "accept.mode"),
        ("pole:", "accept: {max_sigma: {yaw_deg: 0}}\npole:", "accept.max_sigma.yaw_deg"),
        ("pole:", "lasers: []\npole:", "line 6, column 1"),
    ],
)
def test_what_cannot_be_is_refused_at_its_place(change, to, path):
    assert change in LEAST
    assert paths(LEAST.replace(change, to)) == [path]


def test_a_rate_that_the_receivers_line_cannot_carry_is_refused_with_the_arithmetic():
    (fault,) = faults(LEAST.replace("port: /dev/span", "port: /dev/span, baud: 115200, rate_hz: 200"))
    assert "(104 B x 200 + 104 + 76 + 158 B) x 10 bits = 211380 bit/s, 183% of the line" in fault


def test_which_poses_are_trusted_may_be_told():
    told = (
        "port: /dev/span, position_types: [INS_SBAS, NONE], time_status: [COARSE], max_sigma: {height_m: 9}"
    )
    loaded = config.loads(LEAST.replace("port: /dev/span", told)).navigation
    assert (loaded.position_types, loaded.time_status) == (("INS_SBAS", "NONE"), ("COARSE",))
    assert (loaded.max_sigma.height_m, loaded.max_sigma.position_m, loaded.max_off_course_deg) == (9, 0.2, 10)


def test_a_second_laser_needs_its_own_name_and_port_whatever_else_is_wrong():
    second = f"  - port: /dev/lms\n    colour: red\n    mount: {MOUNT}\nnavigation:"
    assert faults(LEAST.replace("navigation:", second)) == [
        "lasers[1].colour: is not a key that polecal knows",
        "lasers[1].name: 'front' is lasers[0].name already",
        "lasers[1].port: '/dev/lms' is lasers[0].port already",
    ]


def test_a_check_of_two_keys_is_not_hidden_by_a_fault_in_a_third():
    text = LEAST.replace("port: /dev/lms", "port: /dev/lms\n    fov_deg: 180\n    baud: 1\n    colour: red")
    assert paths(text) == ["lasers[0].baud", "lasers[0].resolution_deg", "lasers[0].colour"]


def test_no_laser_is_a_fault():
    text = "lasers: []" + LEAST[LEAST.index("\nnavigation") :]
    assert faults(text) == ["lasers: needs at least one laser"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("- port: /dev/lms", "is a list"),
        ("lasers: [1", "line 1, column 11: "),
        ("pole: {radius_m: 1, radius_m: 2}", "line 1, column 21: key 'radius_m' is given twice"),
        ("pole: *gone", "line 1, column 7: found undefined alias"),
        ("a: \x00", "unacceptable character"),
        ("!!python/object/apply:os.system [ls]", "could not determine a constructor"),
    ],
)
def test_what_is_no_mapping_in_yaml_is_refused_with_the_place(text, says):
    (fault,) = faults(text)
    assert says in fault


def test_a_number_may_be_written_with_an_exponent():
    assert config.loads(LEAST.replace("0.04", "4e-2")).pole.radius_m == 0.04


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    for path in (tmp_path / "gone.yaml", tmp_path):
        with pytest.raises(ConfigError, match=str(path)):
            config.load(path)
    (tmp_path / "latin.yaml").write_bytes(b"pole: \xe9")
    with pytest.raises(ConfigError, match="UTF-8"):
        config.load(tmp_path / "latin.yaml")


def test_a_file_is_loaded(tmp_path):
    (tmp_path / "polecal.yaml").write_text(LEAST)
    assert config.load(tmp_path / "polecal.yaml") == config.loads(LEAST)


def test_the_whole_example_of_the_interface_loads(protocol):
    page = (protocol.parent / "interface.md").read_text()
    example = page.split("```yaml\n")[1].split("```")[0]
    loaded = config.loads(example)
    assert loaded.lasers[0].port == "/dev/polecal-lms-front"
    spare = LEAST.replace("/dev/lms", "/dev/polecal-lms-front").replace("/dev/span", "/dev/polecal-span")
    assert loaded == config.loads(spare)  # what it spells out are the defaults


number = st.floats(-50, 50)


@given(
    values=st.tuples(number, number, number, number, number, number),
    hold=st.lists(st.sampled_from(["x", "y", "z", "roll", "pitch", "yaw"]), unique=True),
    port=st.text(min_size=1) | st.sampled_from(["1e5", "-2.5E-3", "yes", "~", "0x10", "1:30", "# a"]),
    radius_m=st.floats(0, 1, exclude_min=True),
)
def test_what_is_dumped_loads_to_the_equal_configuration(values, hold, port, radius_m):
    mount = config.Mount(**dict(zip(config.Mount.model_fields, values, strict=True)))
    made = config.Config(
        lasers=(config.Laser(port="left" + port, mount=mount, hold=tuple(hold)),),
        navigation=config.Navigation(port=port),
        pole=config.Pole(radius_m=radius_m, height_m=2.4),
    )
    assert config.loads(config.dump(made)) == made
