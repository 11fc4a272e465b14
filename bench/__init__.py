"""Measurements: each script writes its numbers as JSON and draws its chart."""
