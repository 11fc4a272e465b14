"""The constants of 95 % intervals."""

LEVEL = 0.95
# Standard deviations to either side of a Gaussian's mean that hold 95 %.
TWO_SIDED_95 = 1.96
