"""`shearloop calibrate`, one module per thing that is calibrated."""
