"""Errors of devices; each message is a sentence for the person at the bench."""

import os


def system_reason(error: OSError) -> str:
    """Return the system's words for an error, such as `Connection refused`, or our own; a timeout has none."""
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or str(error) or "no answer"


class DriverError(Exception):
    """Base class of all errors that drivers raise on purpose."""


class DeviceNotFoundError(DriverError):
    """The device is missing: no such port, serial number or address."""


class DeviceLostError(DriverError):
    """The device disappeared: unplugged, or the connection dropped."""


class DeviceSilentError(DeviceLostError):
    """The device does not answer; it may still be connected."""


class ProtocolError(DriverError):
    """The device answers in a way that its protocol does not allow."""


class DeviceUnavailableError(DriverError):
    """The device is there but cannot be opened: in use by another program, or no permission."""


class DeviceCalibrationError(DriverError):
    """A calibration is unusable, or measurements do not allow one; the message gives the reason."""
