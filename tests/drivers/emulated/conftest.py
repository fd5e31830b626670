"""A host in virtual time, the sheets' telegrams, and the maker's own decoder."""

import json
from collections.abc import Callable
from pathlib import Path

import novatel_edie
import numpy as np
import pytest
from novatel_edie import oem

from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.line import EmulatedDevice
from polecal.drivers.emulated.world import MountPose, World

T0_NS = 1_000_000_000_000


class Host:
    """The other end of a device's line."""

    def __init__(self, device: EmulatedDevice, baud: int) -> None:
        self.device = device
        self.baud = baud
        self.t_ns = T0_NS

    def listen(self, seconds: float) -> bytes:
        self.t_ns += round(seconds * 1e9)
        return self.device.transmit(self.t_ns, self.baud)

    def ask(self, data: bytes, seconds: float = 0.5) -> bytes:
        self.device.receive(self.t_ns, data, self.baud)
        return self.listen(seconds)

    def hear_stamped(self, seconds: float, step_s: float = 0.0005) -> list[tuple[int, bytes]]:
        """Listen in small steps: (moment, bytes) of each that brought something."""
        heard = [(self.t_ns, self.listen(step_s)) for _ in range(round(seconds / step_s))]
        return [(t_ns + round(step_s * 1e9), data) for t_ns, data in heard if data]


@pytest.fixture
def host() -> type[Host]:
    return Host


@pytest.fixture
def t0_ns() -> int:
    return T0_NS


@pytest.fixture(scope="session")
def telegrams(protocol: Path) -> list[dict]:
    """The usable telegrams of the SICK sheet."""
    found = json.loads((protocol / "sick-telegrams.json").read_text())
    return [entry for entry in found if entry["usable"]]


@pytest.fixture(scope="session")
def known(telegrams: list[dict]) -> Callable[[str], bytes]:
    """One telegram of the sheet by the beginning of its name."""

    def find(start: str) -> bytes:
        (entry,) = (entry for entry in telegrams if entry["name"].startswith(start))
        return bytes.fromhex(entry["hex"])

    return find


@pytest.fixture(scope="session")
def edie() -> Callable[[bytes], list]:
    """The maker's decoder: bytes to messages; whatever it cannot read fails the test."""

    def decode(data: bytes) -> list:
        parser = oem.Parser()
        at, out = 0, []
        while at < len(data):
            at += parser.write(data[at : at + parser.available_space])
            out += list(parser)
        unread = [message.data for message in out if isinstance(message, novatel_edie.UnknownBytes)]
        assert not unread
        return out

    return decode


@pytest.fixture
def parked() -> Callable[..., World]:
    """A vehicle that stands at the origin, heading north, 0.1 m above the ground; a pole 5 m ahead."""

    def make(**changes: object) -> World:
        still = SampledTrajectory(
            [0.0, 1e6], np.tile([0, 0, -0.1], (2, 1)), np.zeros((2, 3)), np.zeros((2, 3))
        )
        given = {"mount": MountPose(0, 0, -1.0, 0, -8.0, 0), "pole_ne_m": (5.0, 0.0), "range_noise_m": 0.0}
        return World(**{"trajectory": still, **given, **changes})

    return make
