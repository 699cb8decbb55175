"""Trials of the diagnosis: effects hidden by the generator, in MuJoCo and in measured runs, and what is found of them.

`entries` sizes the effects; `mujoco_bench` and `measured_bench` hide them; `recorder` writes runs as recorders do; `oracle`
gives the size from which an effect is visible; `scores` judges findings. Studies: `trials`, `benches`, `oracle`,
`more_data`.
"""
