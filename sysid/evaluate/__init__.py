"""`jtq evaluate`: the experiments of the paper's section IV, every method beside the torque sensor, on runs never trained on."""
