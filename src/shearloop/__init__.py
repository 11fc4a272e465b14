"""Soft tactile sensing: match frames, estimate torque, read recordings, follow a running daemon.

Match a frame against a bank of simulated signals:

    import shearloop

    bank = shearloop.Bank.open("demo.bank")
    difference = bank.signals[3, 4]  # in volts; of your fingertip: a frame minus the idle frame
    match = shearloop.Matcher.from_bank(bank).match(difference)
    print(match.k, match.sigma, match.score)

Estimate the torque along a recording:

    calibration = shearloop.Calibration.load("fingertip.cal")
    session = shearloop.Session(calibration, bank)
    [series] = shearloop.read_series("twists.mcap", calibration.sides)
    for frame in series.frames():
        print(frame.t_s, session.estimate(frame).torque_nm)

Read what a daemon recorded, as arrays and as pandas frames:

    recording = shearloop.read("twists.mcap")
    print(recording["load.torque"]["torque_nm"].max(), recording.frame("load.torque").describe())

Follow a running daemon, with `for` or `async for`:

    with shearloop.Subscriber(topics=["eit.estimate"]) as subscriber:
        for topic, message in subscriber:
            print(message["torque_nm"])
"""

from typing import TYPE_CHECKING

from shearloop.faces import importer

if TYPE_CHECKING:
    from shearloop.bank.bank_file import Bank
    from shearloop.bank.pruned_matching import PrunedMatcher as Matcher
    from shearloop.daemon.messaging.client import Subscriber
    from shearloop.daemon.messaging.keys import ClientKeys
    from shearloop.estimation import Calibration, Estimate, FrameSeries, Physics, Session, TactileFrame, fit
    from shearloop.studies.emulated_calibration import emulate_recordings
    from shearloop.tools.estimate_tracks import estimate_series
    from shearloop.tools.figures import figures_by_load
    from shearloop.tools.frame_series import read_series
    from shearloop.tools.recordings.tables import read

__all__ = [
    "Bank",
    "Calibration",
    "ClientKeys",
    "Estimate",
    "FrameSeries",
    "Matcher",
    "Physics",
    "Session",
    "Subscriber",
    "TactileFrame",
    "emulate_recordings",
    "estimate_series",
    "figures_by_load",
    "fit",
    "read",
    "read_series",
]

_HOMES = {
    "Bank": "shearloop.bank.bank_file:Bank",
    "Calibration": "shearloop.estimation:Calibration",
    "ClientKeys": "shearloop.daemon.messaging.keys:ClientKeys",
    "Estimate": "shearloop.estimation:Estimate",
    "Session": "shearloop.estimation:Session",
    "FrameSeries": "shearloop.estimation:FrameSeries",
    "Matcher": "shearloop.bank.pruned_matching:PrunedMatcher",
    "Physics": "shearloop.estimation:Physics",
    "Subscriber": "shearloop.daemon.messaging.client:Subscriber",
    "TactileFrame": "shearloop.estimation:TactileFrame",
    "emulate_recordings": "shearloop.studies.emulated_calibration:emulate_recordings",
    "estimate_series": "shearloop.tools.estimate_tracks:estimate_series",
    "figures_by_load": "shearloop.tools.figures:figures_by_load",
    "fit": "shearloop.estimation:fit",
    "read": "shearloop.tools.recordings.tables:read",
    "read_series": "shearloop.tools.frame_series:read_series",
}
__getattr__ = importer(__name__, globals(), _HOMES)
