"""The daemon's own error, and the errors of all rooms that end a command with one sentence and exit status 2."""

from shearloop.bank.errors import BankError
from shearloop.drivers.errors import DriverError
from shearloop.errors import UserError


class InvalidExperimentError(UserError):
    """A file that can be read is no valid experiment; the message has none of its content."""


USER_ERRORS = (BankError, DriverError, UserError)
