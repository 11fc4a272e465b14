"""Errors of devices; each message is a sentence for the person at the bench. Also how a task sees its cancellation."""

import asyncio


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


def is_cancelled() -> bool:
    """Return whether someone asked the current task to end.

    Before Python 3.13 a task group that fails while it is cancelled raises only the failure, so a restart loop has to
    ask here. A group leaves the same mark if its body ends before its tasks, so keep the body running.
    """
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
