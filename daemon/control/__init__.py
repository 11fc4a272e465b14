"""The twist controller, its margins and its identification: plain objects that are told the time and do no I/O."""
