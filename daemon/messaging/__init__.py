"""ZeroMQ messages and commands.

`messages` is the table of topics, which `publisher` sends and `client` receives. `command_server` answers
commands. `stop_socket` answers a stop of `stop_client` on a separate socket. `addresses`, `bound_sockets`,
`keys`, `client_authenticator` and `refusals` say who may connect; `callers` says who sent a command, and `deadlines`
until when it may begin.
"""
