"""What can go wrong with a device, each with what likely caused it."""

from __future__ import annotations

from polecal import PolecalError


class DeviceError(PolecalError):
    """A device cannot be used."""


class DeviceNotFound(DeviceError):
    """The port does not exist, or nothing on it answers: unplugged, no power, wrong path."""


class DeviceBusy(DeviceError):
    """Another program holds the port: a second daemon, a terminal program, ModemManager."""


class DeviceNotPermitted(DeviceError):
    """The user may not open the port: not in group dialout, or no udev rule."""


class DeviceLost(DeviceError):
    """The port stopped working while in use: adapter pulled out, hub reset."""


class DeviceProtocolError(DeviceError):
    """The device answered, but not as its protocol sheet says: refused, wrong type, no reply."""
