"""Towing benches with laws of their own, stand-ins for the real world (docs/testing.md).

Nothing here comes from the estimator, the effect library or the simulation of a joint file, so that what is judged on these
benches is not judged by its own equations. From a joint file: name, gear ratio, and the nominal values that a drive knows.

| module | what it has |
|---|---|
| `bench_file` | bench files as values: `TowingBench`, and how days differ |
| `plant` | bristle friction, gear, temperatures, one joint, and two of them with the sensor between |
| `instruments` | encoders, current measurement, sensor |
"""
