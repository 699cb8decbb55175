"""The torque estimate: observer, losses, network, validity. Pure: no clock, file or socket."""
