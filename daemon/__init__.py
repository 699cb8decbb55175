"""The daemon `jtqd` and the toolbox `jtq`: configuration, loop, CANopen master, recorder, supervision, commands.

`jtqd` and `jtq` are the entry points, `config` is what a configuration file holds; each folder is one process or concern.
Imports drivers, estimator and models; never torch, scipy, sysid or sim_can: the bench is a process of its own.
"""
