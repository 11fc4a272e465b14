"""Soft tactile sensing: match frames, estimate torque, read recordings, follow a running daemon.

Match a frame against a bank of simulated signals:

    import shearloop

    bank = shearloop.Bank.open("demo.bank")
    match = shearloop.Matcher.from_bank(bank).match(difference)  # (896,) volts, frame - homogeneous frame
    print(match.k, match.sigma, match.score)

Estimate the torque along a recording:

    calibration = shearloop.Calibration.load("fingertip.cal")
    session = shearloop.EstimatorSession(calibration, bank)
    [series] = shearloop.read_series("twists.mcap", calibration.sides)
    for t_s, channels in zip(series.t_s, series.channels):
        estimate = session.estimate(shearloop.TactileFrame.of(t_s, channels))
        print(t_s, estimate.torque_nm)

Follow a running daemon:

    for topic, message in shearloop.subscribe("tcp://127.0.0.1:7761", ["eit.estimate"]):
        print(message["torque_nm"])
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.eit.pruned_matching import PrunedMatcher as Matcher
    from shearloop.bank.estimation import Calibration, Estimate, EstimatorSession, FrameSeries, TactileFrame, fit
    from shearloop.daemon.analysis.series import read_series
    from shearloop.daemon.messaging.client import receive_messages as subscribe
    from shearloop.daemon.recording.reader import read_recording

__all__ = [
    "Bank",
    "Calibration",
    "Estimate",
    "EstimatorSession",
    "FrameSeries",
    "Matcher",
    "TactileFrame",
    "fit",
    "read_recording",
    "read_series",
    "subscribe",
]

# ImportResult on first use: the command line answers at once.
_HOMES = {
    "Bank": "shearloop.bank.eit.bank_file:Bank",
    "Calibration": "shearloop.bank.estimation:Calibration",
    "Estimate": "shearloop.bank.estimation:Estimate",
    "EstimatorSession": "shearloop.bank.estimation:EstimatorSession",
    "FrameSeries": "shearloop.bank.estimation:FrameSeries",
    "Matcher": "shearloop.bank.eit.pruned_matching:PrunedMatcher",
    "TactileFrame": "shearloop.bank.estimation:TactileFrame",
    "fit": "shearloop.bank.estimation:fit",
    "read_recording": "shearloop.daemon.recording.reader:read_recording",
    "read_series": "shearloop.daemon.analysis.series:read_series",
    "subscribe": "shearloop.daemon.messaging.client:receive_messages",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'shearloop' has no attribute {name!r}")
    module, _, attribute = _HOMES[name].partition(":")
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value
