"""Errors of joint files on runs: `command` is `jtq score`, `free_run` the simulation of a joint alone.

In: runs, one joint file or two of the same joint. Out: a table, as text or JSON. Imports `sysid.diagnosis` for the balances
of torque.
"""
