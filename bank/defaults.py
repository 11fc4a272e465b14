"""Properties of an estimation that a configuration may change. Configuration and sessions take them from here."""

# Frames in the mean of the idle baseline.
BASELINE_FRAMES = 10
