"""Physics known beforehand: geometry, forward models, banks, matching, calibration.

Pure: arrays in, arrays out. No clock and no I/O but mesh, bank and calibration files.
"""
