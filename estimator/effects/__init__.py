"""Effect library: physical deviations of a joint from the rigid textbook, one file each, for estimator, plant and diagnosis.

`effect` defines what an effect is, `library` has all of them by name and checks their parameters, `regression` turns fitted
coefficients into parameters. Imports the rest of `jtqd.estimator`; nothing but `library` knows which there are.
"""
