"""The compiled part of the loop: what happens in every cycle.

Cython: no stage makes a Python object, and what it knows from one cycle to the next lies in flat blocks (`state` of each
class), so that another loop can go on with a copy. Imports drivers, estimator, daemon.config and daemon.shared.
"""
