"""Analysis of recordings: calibrate, evaluate, reproduce, charts."""
