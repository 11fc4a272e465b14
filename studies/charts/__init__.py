"""Charts of speed against accuracy, stability under faults, and the model that a scene needs."""
