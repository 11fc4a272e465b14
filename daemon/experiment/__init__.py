"""Experiments: what is written in YAML, and the state machine that carries it out."""
