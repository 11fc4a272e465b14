"""The resistive shear skin at run time: measurement model, membrane, calibration."""
