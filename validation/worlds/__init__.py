"""Worlds in which the diagnosis is judged that are not the project's own: docs/diagnosis.md, "Second opinions".

`recorder` writes any run as recorders do; `mujoco_bench` and `measured_bench` hide effects; `oracle` says how large an
effect must be to be visible in a bench; `campaign` scores. Nothing here imports plant, estimator or effect library; the
effects' names and parameters are those of the joint file.
"""
