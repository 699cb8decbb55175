"""The project's generator of trials: a bench of two joints with effects hidden in it, with numpy alone.

`draw` makes sets of runs; `motions`, `plant` and `unknown` are what it draws, integrates and hides.
Nothing of the product is imported; sizes of effects come from `validation.diagnosis.entries`.
"""
