"""The project's recordings: MCAP files of JSON messages, written live or brought in from elsewhere."""
