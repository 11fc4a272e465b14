"""Messages and how they travel: topics, publisher, subscriber, command server, keys."""
