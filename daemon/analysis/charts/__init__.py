"""Charts of speed against accuracy, of stability where methods fail, and of how much model a scene needs."""
