"""The commander: moves joints through planned set-points on a bus on which jtqd runs, within limits.

`shell.play` takes `setpoints.Setpoints` and `setpoints.Limits` and returns a `setpoints.MotionResult`; `commander.Commander`
is the same without socket and clock. Imports `drivers` and `estimator.arrays`, nothing else of sysid.
"""
