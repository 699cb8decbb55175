"""Diagnosis: what the simulation with a joint file gets wrong on recorded runs, by the name of an effect of the library.

In: run tables and joints (`diagnose.diagnose`). Out: `findings.Findings`; `report` and `command` write files of it.
Imports estimator, models, sim_can's plant, and of sysid: campaign plans, excitation, fit.plateaus, runs (in `command`).
"""
