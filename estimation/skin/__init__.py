"""The resistive shear skin: measurement model, membrane, two-dimensional reference, calibration and statistics."""
