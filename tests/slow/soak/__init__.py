"""Soak: jtqd on the emulated bench for long, with faults drawn at random (docs/testing.md)."""
