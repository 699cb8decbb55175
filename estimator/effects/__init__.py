"""The effect library: physical deviations of a joint from the rigid textbook, one file each.

`library.EFFECTS` has all of them by name; `effect` says what an effect is (hooks, parameters, regression terms) and what it
reads of a joint; `functions` and `regression` are what effects share. Imports numpy and `jtqd.estimator.checked` only.
"""
