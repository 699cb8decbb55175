"""Campaigns: plans of runs, played on the bench or an emulated one, recorded by jtqd, checked, resumable.

In: a plan (jtq.plan/1) and jtqd's configuration. Out: a directory with log, run table and marks of every run.
Public modules: `runner`, `state`, `emulated`. Imports drivers, estimator, models, sim_can, daemon.logs, sysid.planner,
sysid.motion, sysid.runs.
"""
