"""Motions planned within limits of position, velocity, acceleration, current, torque and temperature.

In: limits, joint files. Out: plans (schema jtq.plan/1) and their set-points at 1 kHz. No bus, no clock. Modules: `plan`
(segments, runs, YAML, set-points), `fourier` (Fourier trajectories), `design` (D-optimal excitation of two coupled joints),
`single_joint` (a joint moved alone), `campaigns` (efficiency, excitation, validate), `command` (`jtq excitation`).
"""
