"""ZeroMQ messages and commands.

`messages` is the table of topics, which `publisher` sends and `client` receives. `command_server` answers
commands, and `stop_socket` a stop on a socket of its own, for `stop_client`. `addresses`, `bound_sockets`,
`keys` and `refusals` say who may connect; `callers` says who sent a command.
"""
