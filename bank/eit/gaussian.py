"""The one number of the Gaussian distribution that intervals are made with."""

# Standard deviations to either side that hold 95 %.
TWO_SIDED_95 = 1.96
