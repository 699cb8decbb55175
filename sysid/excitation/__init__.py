"""Excitation runs for identification: `jtq excitation`, and the designs of `jtq campaign excitation`.

In: limits, joint files. Out: Fourier trajectories of velocity and current, as segments of a plan. Modules: `design`
(D-optimal runs), `model` (limits, torque), `fourier` (the series), `command`. Imports estimator, models, sysid.campaign.
"""
