"""Motion of both joints over the bus: set-points, limits, CiA 402 sequences, and the node that commands the drives."""
