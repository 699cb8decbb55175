"""Recorded logs: reading, repair and export."""
