"""What a person runs at the desk: recordings, calibrations, evaluation, checks."""
