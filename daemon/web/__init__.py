"""The live view: a page on loopback that shows a daemon's messages and passes commands on."""
