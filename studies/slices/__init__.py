"""Slices: the papers' peak samples, their calibrations, estimates and figures."""
