"""Motions planned within limits of position, velocity, acceleration, current, torque and temperature.

In: limits, joint files. Out: plans (schema jtq.plan/1) and their set-points at 1 kHz. No bus, no clock. Modules: `plan`
(Fourier series, segments, runs, YAML, set-points), `design` (D-optimal excitation), `campaigns` (efficiency, excitation,
validate), `experiments` (of a diagnosis), `command` (`jtq excitation`).
"""
