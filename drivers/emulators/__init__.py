"""The devices of `drivers`, played byte for byte over real pseudo-terminals and sockets."""
