"""The goals: four plants, our estimate and its baselines, against the torque that only a plant knows."""
