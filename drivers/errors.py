"""What can go wrong with a device. Every message is a sentence for the person at the bench."""


class DriverError(Exception):
    """The root of all errors that `drivers` raises on purpose."""


class DeviceNotFoundError(DriverError):
    """The device is not there: no such port, serial number or address."""


class DeviceLostError(DriverError):
    """The device was there and is gone: unplugged, or the connection dropped."""


class DeviceSilentError(DeviceLostError):
    """The device has not answered; whether it is still there is not known."""


class ProtocolError(DriverError):
    """The device answers, but not in its own language."""


class DeviceUnavailableError(DriverError):
    """The device is there but cannot be had: in use by another program, or without permission."""
