"""The reference models and statistics of the resistive shear skin, for comparison with its paper."""
