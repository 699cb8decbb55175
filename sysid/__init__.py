"""Identification: emulated and measured runs, fits, training, reports."""
