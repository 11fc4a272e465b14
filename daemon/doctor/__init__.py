"""Walks through everything that a person who is stuck would check, and says what was found and what to do."""
