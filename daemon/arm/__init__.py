"""External torque of an arm: a reader beside the running jtqd, one per bus, whose joints are joints of a URDF.

`jtqd-arm ARM.yaml` (`process`) opens the memory of the daemons (`sources`), gives every cycle of the slowest bus to the
estimator (`estimator`, `model`) and records or shows what pushes on the arm (`messages`). Nothing of it is in a loop.
"""
