"""CANopen master in service, beside the loop: boots of nodes, their configuration, errors on the bus, jtqd as a node.

In: frames of a socket of its own and the loop's snapshot. Out: boots, SDO requests, EMCY, conditions. `service` has the
socket and the clock; the other modules are pure.
"""
