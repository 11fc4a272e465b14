"""The channels of a configured fingertip, for a tool that opens its board alone."""

import os

from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.config import FingertipConfig
from shearloop.estimation import Calibration


def fingertip_table(config: FingertipConfig) -> ChannelTable:
    """Return a fingertip's channels, by its bank or its calibration, else the paper's; raises BankError."""
    if config.bank is not None:
        return Bank.open(config.bank).table
    if config.calibration is not None and os.path.exists(config.calibration):
        return Calibration.load(config.calibration).table
    return PAPER_TABLE
