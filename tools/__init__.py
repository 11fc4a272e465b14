"""The programs for the desk: recordings, calibrations, evaluation, checks."""
