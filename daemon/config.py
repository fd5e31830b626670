"""The operator's YAML file as a checked, frozen Config, or every fault in it at once."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from polecal import PolecalError

SPAN = "span"
"""The receiver's name wherever devices are named; no laser may have it."""

_VARIANTS = {100: (0.25, 0.5, 1.0), 180: (0.5, 1.0), 90: (0.5,)}
"""Resolutions (deg) by field of view (deg) that an LMS-2xx has; 90 is the S14's only one. LMS sheet, 7."""

_ONTIME_HZ = (1, 2, 4, 5, 10, 20, 50, 100, 200)
"""Rates of NovAtel's ONTIME trigger from 1 Hz up. SPAN sheet, 5."""

_SPAN_BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)

_POSITION_TYPES = (
    *("INS_RTKFIXED", "INS_RTKFLOAT", "INS_PSRDIFF", "INS_PPP", "INS_PPP_CONVERGING", "INS_PPP_BASIC"),
    *("INS_PPP_BASIC_CONVERGING", "INS_OMNISTAR", "INS_OMNISTAR_HP", "INS_OMNISTAR_XP", "RTK_DIRECT_INS"),
    *("NARROW_INT", "WIDE_INT", "L1_INT", "NARROW_FLOAT", "IONOFREE_FLOAT", "L1_FLOAT", "PSRDIFF"),
    *("PPP", "PPP_CONVERGING", "PPP_BASIC", "PPP_BASIC_CONVERGING"),
    *("OMNISTAR", "OMNISTAR_HP", "OMNISTAR_XP"),
)
"""With corrections of some kind; without (INS_PSRSP, INS_SBAS, SINGLE, WAAS, NONE) a position wanders by more
between two passes than the laser's whole offset. How good the corrections are, the sigmas tell."""

_TIME_STATUS = ("FINE", "FINEBACKUPSTEERING", "FINESTEERING")
"""The receiver's time may be mapped to the host's. SPAN sheet, 3.4."""


class ConfigError(PolecalError):
    """A configuration that cannot be used; ``faults`` has a line for each thing wrong with it."""

    code = 78

    def __init__(self, source: str, faults: list[str]) -> None:
        number = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
        listed = "".join(f"\n  {fault}" for fault in faults)
        super().__init__(f"{source}: {number}{listed}", "correct the file; README.md shows a whole one")
        self.faults = faults


def _one_of(*allowed: float) -> AfterValidator:
    def check(value: float) -> float:
        if value not in allowed:
            listed = ", ".join(f"{a:g}" if a < 1 else f"{a:.0f}" for a in allowed)
            raise _fault(f"must be one of {listed}, not {value:g}")
        return value

    return AfterValidator(check)


def _fault(message: str) -> PydanticCustomError:
    return PydanticCustomError("polecal", "{message}", {"message": message})


def _laser_name(name: str) -> str:
    if name == SPAN:
        raise _fault(f"{SPAN!r} is the receiver's own name")
    return name


def _each_once(hold: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(hold)) < len(hold):
        raise _fault("names one unknown twice")
    return hold


def _at_least_one(lasers: tuple[Laser, ...]) -> tuple[Laser, ...]:
    if not lasers:
        raise _fault("needs at least one laser")
    return lasers


Positive = Annotated[float, Field(gt=0)]
Offset = Annotated[float, Field(ge=-50, le=50)]  # a vehicle; catches millimetres taken for metres
Angle = Annotated[float, Field(ge=-360, le=360)]
Place = Annotated[Path, Field(strict=False)]
PortPath = Annotated[str, StringConstraints(min_length=1)]
Unknown = Literal["x", "y", "z", "roll", "pitch", "yaw"]


class _Part(BaseModel):
    # Defaults are checked too: each may clash with a neighbour that was given.
    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
        use_attribute_docstrings=True,  # for polecal.yaml(5)
    )


class Mount(_Part):
    """A laser's pose on the body as measured by hand: m and degrees, body FRD, order yaw pitch roll."""

    x_m: Offset
    """Forward from the point whose position the receiver reports, m."""
    y_m: Offset
    """To the right, m."""
    z_m: Offset
    """Down, m: a laser above that point has a negative one."""
    roll_deg: Angle
    """Right side down is positive, degrees."""
    pitch_deg: Angle
    """Looking up is positive, degrees."""
    yaw_deg: Angle
    """To the right is positive, degrees."""


class MountSigma(_Part):
    """How well the mount was measured, one standard deviation."""

    xyz_m: Positive = 0.1
    """Of each of x, y and z, m."""
    rpy_deg: Positive = 5.0
    """Of each of roll, pitch and yaw, degrees."""


class Laser(_Part):
    """One laser: where it is plugged in, how it shall scan, where it sits."""

    name: Annotated[str, StringConstraints(pattern=r"^[a-z0-9_-]{1,32}$"), AfterValidator(_laser_name)] = (
        "front"
    )
    """What it is called in status, results and files."""
    port: PortPath
    """Its serial port; best a name by udev that stays."""
    baud: Annotated[int, _one_of(9600, 19200, 38400, 500000)] = 500000
    """The line's rate, bit/s; the laser is found at whatever rate it is, and brought to this one."""
    fov_deg: Annotated[int, _one_of(90, 100, 180)] = 100
    """Its field of view, degrees; 90 is the S14's."""
    resolution_deg: Annotated[float, _one_of(0.25, 0.5, 1.0)] = 0.25
    """The angle between beams, degrees."""
    reflectivity: Literal["levels", "energy", "s14"] = "levels"
    """How it tells a reflector: levels (3 bits in each value), energy (with each value), s14 (that type's
    way)."""
    mount: Mount
    """Where it sits, as measured by hand."""
    mount_sigma: MountSigma = MountSigma()
    """How well that was measured."""
    hold: Annotated[tuple[Unknown, ...], Field(strict=False), AfterValidator(_each_once)] = ()
    """What of x y z roll pitch yaw is not calibrated, but kept as measured."""

    # Checks of two fields sit on the later one, so that a fault in a third does not hide them.
    @field_validator("resolution_deg")
    @classmethod
    def _goes_with_the_field_of_view(cls, resolution_deg: float, info: ValidationInfo) -> float:
        fov_deg = info.data.get("fov_deg")
        if fov_deg is not None and resolution_deg not in _VARIANTS[fov_deg]:
            can = " or ".join(f"{r:g}" for r in _VARIANTS[fov_deg])
            raise _fault(f"{resolution_deg:g}° does not go with fov_deg {fov_deg}: needs {can}")
        return resolution_deg

    @field_validator("reflectivity")
    @classmethod
    def _some_laser_can_do_it(cls, reflectivity: str, info: ValidationInfo) -> str:
        from polecal.drivers.sick_lms import refusal  # noqa: PLC0415 - numpy; the operator's command has none

        fov_deg, resolution_deg, baud = map(info.data.get, ("fov_deg", "resolution_deg", "baud"))
        if fov_deg and resolution_deg and baud:
            reason = refusal(fov_deg, resolution_deg, reflectivity, baud)
            if reason:
                raise _fault(reason)
        return reflectivity


class NavigationSigma(_Part):
    """The largest standard deviations, as the receiver tells them, at which its poses are used.

    A recorded PPP drive stays under 0.06 m, 0.1 m, 0.035 m/s, 0.03° and 0.3°; code corrections alone (0.4 m)
    are refused, as passes would differ by more than an accepted calibration may.
    """

    position_m: Positive = 0.2
    """North and east, each, m."""
    height_m: Positive = 0.3
    """Height, m."""
    velocity_mps: Positive = 0.1
    """North, east and down, each, m/s."""
    roll_pitch_deg: Positive = 0.1
    """Roll and pitch, each, degrees."""
    azimuth_deg: Positive = 0.5
    """Azimuth, degrees."""


class Navigation(_Part):
    """The SPAN receiver's line and pose rate, and which of its poses are trusted.

    ``position_types`` and ``time_status`` by NovAtel's names. ``max_off_course_deg`` is how far azimuth and
    course over ground may differ on a straight, forward or in reverse; 90 never refuses.
    """

    port: PortPath
    """The receiver's serial port; best a name by udev that stays."""
    baud: Annotated[int, _one_of(*_SPAN_BAUDS)] = 230400
    """The line's rate, bit/s; the receiver is found at whatever rate it is, and brought to this one."""
    rate_hz: Annotated[int, _one_of(*_ONTIME_HZ)] = 100
    """How many poses a second it shall send; they must fit the line."""
    position_types: Annotated[tuple[str, ...], Field(strict=False)] = _POSITION_TYPES
    """What its position may rest on, by NovAtel's names; by default whatever has corrections."""
    time_status: Annotated[tuple[str, ...], Field(strict=False)] = _TIME_STATUS
    """How well it must know the time, by NovAtel's names."""
    max_sigma: NavigationSigma = NavigationSigma()
    """How uncertain it may be."""
    max_off_course_deg: Annotated[float, Field(gt=0, le=90)] = 10.0
    """How far azimuth and course over ground may differ on a straight, degrees; 90 never refuses."""

    @field_validator("rate_hz")
    @classmethod
    def _fits_the_line(cls, rate_hz: int, info: ValidationInfo) -> int:
        from polecal.drivers.novatel_span.requests import POSES, refusal, slow_logs  # noqa: PLC0415 - numpy

        baud = info.data.get("baud")
        if baud and (reason := refusal(POSES[0], rate_hz, baud, slow_logs(POSES[0]))):
            raise _fault(reason)
        return rate_hz

    @field_validator("position_types", "time_status")
    @classmethod
    def _are_the_receivers_words(cls, names: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        from polecal.drivers.novatel_span import PositionType, TimeStatus  # noqa: PLC0415 - numpy

        known = PositionType if info.field_name == "position_types" else TimeStatus
        unknown = [name for name in names if name not in known.__members__]
        if unknown or not names:
            raise _fault(
                f"{unknown[0]!r} is none of NovAtel's" if unknown else "names none: no pose would do"
            )
        return names


class Pole(_Part):
    """The retro-reflective pole."""

    radius_m: Annotated[float, Field(gt=0, le=1)]
    """Of the pole with its tape, m."""
    height_m: Positive
    """From the ground to its top, m."""


class Routine(_Part):
    """What has to be driven before there is enough."""

    slice_deg: Annotated[int, Field(gt=0, le=360)] = 30
    """How wide a slice of headings is, degrees; divides 360."""
    min_pole_returns: Annotated[int, Field(ge=1)] = 100
    """So many returns from the pole in each slice."""
    min_passes: Annotated[int, Field(ge=1)] = 1
    """So many passes in each slice."""
    slices_needed: Annotated[int, Field(ge=1)] = 12
    """So many slices must have them."""
    max_passes: Annotated[int, Field(ge=1, le=500)] = 200
    """After so many passes of a reflector, of all days together, a run ends with what there is."""

    @field_validator("slice_deg")
    @classmethod
    def _whole_slices(cls, slice_deg: int) -> int:
        if 360 % slice_deg:
            raise _fault(f"{slice_deg} does not divide 360")
        return slice_deg

    @field_validator("slices_needed")
    @classmethod
    def _no_more_than_there_are(cls, slices_needed: int, info: ValidationInfo) -> int:
        slice_deg = info.data.get("slice_deg")
        if slice_deg is not None and slices_needed > 360 // slice_deg:
            raise _fault(f"{slices_needed} of only {360 // slice_deg} slices of {slice_deg}°")
        return slices_needed

    @field_validator("max_passes")
    @classmethod
    def _no_fewer_than_each_slice_needs(cls, max_passes: int, info: ValidationInfo) -> int:
        min_passes = info.data.get("min_passes")
        if min_passes is not None and max_passes < min_passes:
            raise _fault(f"{max_passes} passes in all, but each slice needs {min_passes}")
        return max_passes


class MaxSigma(_Part):
    """The largest standard deviations that an accepted calibration may have."""

    xy_m: Positive = 0.02
    """Of x and of y, m."""
    z_m: Positive = 0.02
    """Of z, m."""
    roll_deg: Positive = 0.1
    """Of roll, degrees."""
    pitch_deg: Positive = 0.1
    """Of pitch, degrees."""
    yaw_deg: Positive = 0.1
    """Of yaw, degrees."""


class Accept(_Part):
    """What makes a calibration good enough; ``cost_m`` is on the square root of Eq. 7.

    ``left_out_m`` is on the same of passes left out of the fit; ``improvement`` on the part of it by which it
    still falls through the last passes, ``doubling`` from every second pass to all.
    """

    cost_m: Positive = 0.05
    """The largest cost, the square root of Eq. 7, m."""
    left_out_m: Positive = 0.06
    """The largest cost of passes that were left out of the fit, m."""
    improvement: Annotated[float, Field(gt=0, lt=1)] = 0.02
    """The largest part of the cost by which it may still fall through the last passes."""
    doubling: Annotated[float, Field(gt=0, lt=1)] = 0.05
    """The largest part of the cost by which it may change from every second pass to all."""
    mode: Literal["all", "any"] = "all"
    """Whether all of the criteria must be met, or any."""
    max_sigma: MaxSigma = MaxSigma()
    """How uncertain the result may be."""


class Storage(_Part):
    """How much of the disk the sessions may take (MB of 10⁶ bytes): the oldest that were not accepted go.

    ``decoded`` captures can be looked at in robot tools: scans, fixes, frames and clouds are in them.
    """

    min_free_mb: Annotated[int, Field(ge=1)] = 200
    """So much stays free on the disk; below it nothing is recorded, MB."""
    quota_mb: Annotated[int, Field(ge=1)] | None = None
    """So much all sessions may take, MB; null: as much as there is."""
    decoded: bool = True
    """Whether a closed capture has scans, fixes, frames and clouds in it, too, for robot tools."""


def split_address(listen: str) -> tuple[str, int]:
    """Take an IP address and a port apart, as in 127.0.0.1:8291 or [::1]:8291. Raises ValueError."""
    host, _, port = listen.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    address = ipaddress.ip_address(bare)
    if (address.version == 6) is (bare == host) or not re.fullmatch("[0-9]{1,5}", port):
        raise ValueError(listen)
    if not 0 < int(port) <= 0xFFFF:
        raise ValueError(listen)
    return bare, int(port)


def _address(listen: str) -> str:
    try:
        split_address(listen)
    except ValueError as error:
        raise _fault(f"must be an IP address and a port, as 127.0.0.1:8291, not {listen!r}") from error
    return listen


class Page(_Part):
    """A page for a tablet's browser, which shows what `status` does and changes nothing; off by default."""

    listen: Annotated[str, AfterValidator(_address)] | None = None
    """The IP address and port that it is served at, as 127.0.0.1:8291; null: nowhere. Who reaches it can
    look: there is no password."""


class Config(_Part):
    """All that the daemon is told."""

    state_dir: Place = Path("/var/lib/polecal")
    """Where the sessions are."""
    runtime_dir: Place = Path("/run/polecal")
    """Where the control socket is."""
    lasers: Annotated[tuple[Laser, ...], Field(strict=False), AfterValidator(_at_least_one)]
    """The lasers, one or more."""
    navigation: Navigation
    """The receiver."""
    pole: Pole
    """The pole."""
    routine: Routine = Routine()
    """What has to be driven."""
    accept: Accept = Accept()
    """What makes a calibration good enough."""
    storage: Storage = Storage()
    """How much of the disk sessions may take."""
    page: Page = Page()
    """A page for a tablet."""

    @property
    def socket(self) -> Path:
        """Where the control socket is."""
        return self.runtime_dir / "control.sock"


def load(path: Path | str) -> Config:
    """Read a configuration file. Raises ConfigError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), [f"cannot be read: {error.strerror}"]) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), [f"is not UTF-8 text: {error.reason} at byte {error.start}"]) from error
    return loads(text, str(path))


def loads(text: str, source: str = "configuration") -> Config:
    """Check a configuration given as YAML text; ``source`` names it in errors. Raises ConfigError."""
    try:
        content = yaml.load(text, _Loader)  # noqa: S506 - a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        at = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ConfigError(source, [f"{at}{error.problem}"]) from error
    except yaml.YAMLError as error:
        raise ConfigError(source, [" ".join(str(error).split())]) from error
    if not isinstance(content, dict):
        found = "is empty" if content is None else f"is a {type(content).__name__}"
        raise ConfigError(source, [f"{found}, not keys with values"])
    faults = []
    try:
        config = Config.model_validate(content)
    except ValidationError as error:
        faults = [_line(details) for details in error.errors(include_url=False)]
    faults += _clashes(content)
    if faults:
        raise ConfigError(source, faults)
    return config


def dump(config: Config) -> str:
    """Write a configuration as YAML that loads to an equal one, every default spelt out."""
    return yaml.dump(config.model_dump(mode="json"), Dumper=_Dumper, sort_keys=False)


def _clashes(content: dict[Any, Any]) -> list[str]:
    """Find names and ports given twice; on the raw content, so that other faults do not hide them."""
    lasers = content.get("lasers")
    navigation = content.get("navigation")
    named: list[tuple[str, object]] = []
    plugged: list[tuple[str, object]] = []
    for i, laser in enumerate(lasers if isinstance(lasers, list) else []):
        if isinstance(laser, dict):
            named.append((f"lasers[{i}].name", laser.get("name", Laser.model_fields["name"].default)))
            plugged.append((f"lasers[{i}].port", laser.get("port")))
    if isinstance(navigation, dict):
        plugged.append(("navigation.port", navigation.get("port")))
    faults = []
    for pairs in (named, plugged):
        first: dict[str, str] = {}
        for path, value in pairs:
            if isinstance(value, str):
                if value in first:
                    faults.append(f"{path}: {value!r} is {first[value]} already")
                first.setdefault(value, path)
    return faults


def _line(details: ErrorDetails) -> str:
    """Say one fault as ``path: what``."""
    path = ""
    for step in details["loc"]:
        path += f"[{step}]" if isinstance(step, int) else f".{step}" if path else str(step)
    match details["type"]:
        case "missing":
            what = "is missing"
        case "extra_forbidden":
            what = "is not a key that polecal knows"
        case "string_too_short":
            what = "is empty"
        case "tuple_type":
            what = f"must be a list, not {details['input']!r}"
        case "model_type":
            what = f"must be keys with values, not {details['input']!r}"
        case "string_pattern_mismatch":
            what = f"must be 1 to 32 of a-z 0-9 _ -, not {details['input']!r}"
        case "polecal":
            what = details["msg"]
        case _:
            given = details["input"]
            said = f", not {given!r}" if isinstance(given, str | int | float) else ""
            what = details["msg"][:1].lower() + details["msg"][1:] + said
            what = what.replace("input should be", "must be")
    return f"{path}: {what}"


class _Loader(yaml.SafeLoader):
    """YAML without keys given twice, and with 1e-3 a number, as in YAML 1.2."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        problem=f"key {key.value!r} is given twice", problem_mark=key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Quotes the strings that `_Loader` would take for numbers."""


for _either in (_Loader, _Dumper):
    _either.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
        list("-+.0123456789"),
    )
