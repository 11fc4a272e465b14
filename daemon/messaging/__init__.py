"""The way out and in: who may connect where, what is sent to whoever listens, commands that are asked and answered."""
