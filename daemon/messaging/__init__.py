"""ZeroMQ messages and commands: the table of topics, publisher, client, command server, addresses and keys."""
