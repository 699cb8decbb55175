"""`jtq evaluate`: section IV of the paper, every method beside the torque sensor, on runs that no model has seen."""
