"""A probe finds what is on a port and leaves it as it was: each driver's, with the emulated devices."""

from __future__ import annotations

import numpy as np
import pytest

from polecal.drivers.emulated import laser_telegrams as lms
from polecal.drivers.emulated.drive import SampledTrajectory
from polecal.drivers.emulated.laser import EmulatedLaser, Quirks
from polecal.drivers.emulated.receiver import EmulatedReceiver
from polecal.drivers.emulated.span_generations import OEM4, OEM6, OEM7, OEMV
from polecal.drivers.emulated.world import MountPose, World
from polecal.drivers.novatel_span import InsConfig, MessageId, NovatelSpan, TimeStatus
from polecal.drivers.novatel_span.device import RATES as SPAN_RATES
from polecal.drivers.novatel_span.probe import probe as span_probe
from polecal.drivers.sick_lms import SickLms
from polecal.drivers.sick_lms.probe import probe as lms_probe

LMS_RATES = (500000, 9600, 38400, 19200)
SECOND = 10**9


@pytest.fixture
def world():
    still = SampledTrajectory([0.0, 1e6], np.tile([0, 0, -0.1], (2, 1)), np.zeros((2, 3)), np.zeros((2, 3)))
    return World(still, mount=MountPose(0, 0, -1.0, 0, -8.0, 0), pole_ne_m=(5.0, 0.0))


@pytest.fixture
def port_of(clock, connected, monkeypatch):
    """A port at whose other end a device is."""
    monkeypatch.setattr("polecal.drivers.novatel_span.probe.time", clock)

    def make(device):
        connected(device)
        if isinstance(device, EmulatedLaser):
            driver = SickLms("front", "/dev/virtual", 9600, lambda *_: None, resolution_deg=0.5)
        else:
            driver = NovatelSpan("span", "/dev/virtual", 230400, lambda *_: None)
        return driver.open(clock.stop())

    return make


def set_up_of(device):
    """All of a device that a probe must not change."""
    if isinstance(device, EmulatedLaser):
        return device.mode, device.baud, device.config, device.variant, device.streaming, device.eeprom_writes
    return device.baud, {key: wanted.period_ms for key, wanted in device._logs.items()}, device._replies


@pytest.mark.parametrize("baud", LMS_RATES)
@pytest.mark.parametrize("kind", ["LMS291;S05;V02.10 ", "LMS291;S14;V02.10 ", "LMS200;S18063;V02.19 "])
def test_a_laser_is_found_at_whatever_rate_it_rests(baud, kind, world, clock, port_of):
    laser = EmulatedLaser(world, t0_ns=clock.ns - 2 * SECOND, baud=baud, type_string=kind)
    port = port_of(laser)
    before = set_up_of(laser)
    found = lms_probe(port, LMS_RATES)
    assert found.baud == baud
    assert found.identity == kind.strip()
    assert found.status is not None
    assert found.status.baud == baud
    assert found.errors is not None
    assert set_up_of(laser) == before


def test_a_streaming_laser_goes_on_and_one_that_overlooks_requests_is_found(world, clock, port_of):
    quirks = Quirks(overlooked=0.3, lost_ack=0.2, cut_scan=0.05)
    laser = EmulatedLaser(world, t0_ns=clock.ns - 2 * SECOND, eeprom=lms.STREAM_CONFIG, quirks=quirks, seed=3)
    laser.force_stream(clock.ns)
    before = set_up_of(laser)
    port = port_of(laser)
    found = lms_probe(port, LMS_RATES)
    assert found.baud == 500000
    assert laser.streaming
    assert set_up_of(laser) == before


def test_a_laser_without_power_is_not_found_and_nothing_was_heard(world, clock, port_of):
    laser = EmulatedLaser(world, t0_ns=clock.ns, boot_s=1e6)
    found = lms_probe(port_of(laser), LMS_RATES)
    assert found.baud is None
    assert set(found.heard) == set(LMS_RATES)
    assert not any(found.heard.values())
    assert not found.frames_heard


@pytest.mark.parametrize("generation", [OEM4, OEMV, OEM6, OEM7])
@pytest.mark.parametrize("mode", ["NOVATEL ON", "NOVATEL OFF", "NOVATELBINARY ON"])
def test_a_receiver_of_each_generation_is_asked_in_the_form_that_it_takes(
    generation, mode, world, clock, port_of
):
    receiver = EmulatedReceiver(
        world, t0_ns=clock.ns - 2 * SECOND, baud=38400, generation=generation, aligned_after_s=-9.0
    )
    receiver.receive(clock.ns, f"INTERFACEMODE COM1 {mode.replace(' ', ' NOVATEL ')}\r\n".encode(), 38400)
    clock.to(clock.ns + SECOND)
    receiver.transmit(clock.ns, 38400)
    before = set_up_of(receiver)
    found = span_probe(port_of(receiver), SPAN_RATES)
    assert found.baud == 38400
    assert found.version is not None
    assert found.time_status == TimeStatus.FINESTEERING
    assert MessageId.TIME in found.said
    assert MessageId.BESTPOS in found.said
    assert {MessageId.INSPVAS, MessageId.INSPVAX} & set(found.said)
    assert isinstance(found.said.get(MessageId.INSCONFIG), InsConfig) == (generation is OEM7)
    assert set_up_of(receiver) == before


def test_a_receiver_in_the_midst_of_its_logs_goes_on_sending_them(world, clock, port_of):
    receiver = EmulatedReceiver(world, t0_ns=clock.ns - 2 * SECOND, aligned_after_s=-9.0)
    receiver.force_logs(clock.ns, [("INSPVASB", 0.01), ("BESTPOSB", 1.0), ("TIMEB", 1.0)])
    before = set_up_of(receiver)
    found = span_probe(port_of(receiver), SPAN_RATES)
    assert found.baud == 230400
    assert set_up_of(receiver) == before


def test_what_a_receiver_refuses_is_told(world, clock, port_of):
    receiver = EmulatedReceiver(
        world, t0_ns=clock.ns - 2 * SECOND, aligned_after_s=-9.0, refused=("INSPVAS", "INSPVAX")
    )
    found = span_probe(port_of(receiver), SPAN_RATES)
    assert {"INSPVAS", "INSPVAX"} <= set(found.refused)
    assert all(found.refused.values())


def test_a_receiver_that_boots_for_ever_is_not_found(world, clock, port_of):
    receiver = EmulatedReceiver(world, t0_ns=clock.ns + 10**6 * SECOND)
    found = span_probe(port_of(receiver), SPAN_RATES)
    assert (found.baud, found.checked) == (None, None)
