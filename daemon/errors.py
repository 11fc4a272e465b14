"""The errors of all rooms that end a command with one sentence and exit status 2."""

from shearloop.bank.errors import BankError
from shearloop.drivers.errors import DriverError
from shearloop.errors import UserError

USER_ERRORS = (BankError, DriverError, UserError)
