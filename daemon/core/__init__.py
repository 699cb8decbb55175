"""The compiled part of the loop: what happens in every cycle. No stage makes a Python object.

May import `drivers`, `estimator`, `daemon.config` and `daemon.shared`.
"""
