"""Recordings at the desk: read, repair, export, replay and import MCAP files."""
