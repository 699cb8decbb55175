"""The emulated bench: plant of two joints and one sensor, and its CANopen nodes on a bus."""
