"""ZeroMQ messages and commands: the table of topics, publisher, client, servers of commands, keys."""
