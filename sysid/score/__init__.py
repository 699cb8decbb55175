"""Score of joint files on runs: error of the simulation and of every estimator, before and after.

In: one or two joint files, runs. Out: `Score`, frozen; a table or JSON. Modules: `score` (pure), `command`.
"""
