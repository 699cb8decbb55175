"""Identification of an arm from its own motion: `jtq fit arm`."""
