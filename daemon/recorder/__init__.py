"""The writer of recordings: MCAP files of JSON messages, and their schemas."""
