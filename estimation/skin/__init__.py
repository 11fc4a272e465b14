"""What the resistive shear skin needs at run time: measurement model, membrane, calibration."""
