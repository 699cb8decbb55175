"""The CANopen master in service, beside the loop: nodes that come and go, their configuration, errors, jtqd as a node.

In: frames of a socket of its own and the loop's snapshot. Out: boots, SDO requests, EMCY, conditions (`service` is the
shell, the others are pure). May import `drivers`, `daemon.shared`, `daemon.config` and `daemon.core.estimate_pdo`.
"""
