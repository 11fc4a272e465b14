"""Recordings: write, import, read, replay, repair and export MCAP files of JSON messages."""
