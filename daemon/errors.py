"""Mistakes that end a command with one sentence and exit status 2."""


class UserError(Exception):
    """Something in a configuration, a file or a command line that its author can mend; the message says how."""
