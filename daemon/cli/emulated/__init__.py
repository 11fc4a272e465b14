"""`shearloop emulate`, one module per device."""
