"""The live view: one page on loopback that shows what a daemon publishes, and passes commands on."""
