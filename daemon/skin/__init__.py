"""The shear skin in the daemon: its zero, its estimator, its task, and how it is built from the configuration."""
