"""The CANopen master in service, beside the loop: nodes, configuration, errors, jtqd as a node."""
