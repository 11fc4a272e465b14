"""Properties of an estimation that a configuration may change. Configuration and sessions take them from here."""

# Frames in the mean of the idle baseline.
BASELINE_FRAMES = 10
# Frames with at least this torque are loaded, where accuracy is judged.
LOADED_NM = 0.005
# A longer gap restarts the average of frames.
MAX_GAP_S = 3.0
