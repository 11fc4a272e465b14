"""The daemon as a systemd service: installation and real-time options."""
