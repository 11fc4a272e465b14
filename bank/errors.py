"""What can go wrong with geometry, banks and calibrations. Every message is a sentence for the person at the bench."""


class BankError(Exception):
    """The root of all errors that `bank` raises on purpose."""


class GeometryError(BankError):
    """A mesh or fingertip description that cannot be used."""


class ModelError(BankError):
    """A basis model or parameter that does not exist, or that no conductivity can be computed for."""


class ConductivityError(ModelError):
    """A conductivity that is not positive everywhere: the equations have no physical solution."""


class BankFileError(BankError):
    """A bank file that is truncated, foreign, stale or damaged."""


class MatchingError(BankError):
    """A difference or a bank that cannot be matched."""


class CalibrationError(BankError):
    """A calibration that cannot be made from the data given, or a calibration file that cannot be used."""
