"""Score the estimator on shipped runs of a real arm (models/kinova_gen3): `python -m validation measured`.

In: measured runs, joint files. Out: errors against the arm's torque sensor, figures, fitted joint files.
Modules: `offline` (the estimate from the file), `bus` (jtqd against the played run), `figures`, `command`.
Imports estimator, models, daemon.logs, sysid.fit, sysid.runs.
"""
