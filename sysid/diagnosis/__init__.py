"""Diagnosis: what the simulation gets wrong in measured runs, the cause by name, the gain, the next experiment."""
