"""Commissioning: measures what a rig of real devices does, stage after stage, and keeps the results in a report."""
