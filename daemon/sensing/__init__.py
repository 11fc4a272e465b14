"""The tasks that read sensors and estimate: fingertips, shear skin, load cell."""
