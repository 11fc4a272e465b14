"""Control: the loop, the controller, identification, safety, and experiments."""
