"""The number formats of times in programs, for the first column of MATLAB streams."""

from typing import NamedTuple


class TimeFormat(NamedTuple):
    """Unix time is (number − `epoch`) · `unit_s`."""

    unit_s: float
    # The number of 1970-01-01.
    epoch: float
    words: str
    has_date: bool = True


_DAY_S = 86400.0
# Numbers without a date begin on the second of January 1970, so that no corrected time is before Unix time begins.
TIME_FORMATS = {
    "datenum": TimeFormat(_DAY_S, 719529.0, "MATLAB's days since the year 0"),
    "unix": TimeFormat(1.0, 0.0, "seconds since 1970"),
    "unix-ms": TimeFormat(1e-3, 0.0, "milliseconds since 1970"),
    "excel": TimeFormat(_DAY_S, 25569.0, "Excel's days since 1900"),
    "elapsed": TimeFormat(1.0, -_DAY_S, "seconds since the start", has_date=False),
    "elapsed-ms": TimeFormat(1e-3, -1e3 * _DAY_S, "milliseconds since the start", has_date=False),
}
DATENUM = "datenum"

# The recording scripts changed these names over time.
STREAM_VARIABLES = {
    "right": ("Right_Data", "plotthis2", "plotthis_right"),
    "left": ("Left_Data", "plotthis1", "plotthis_left"),
    "load": ("Load_Data", "plotthis3", "plotthis_truth"),
}
