"""The project's generator of trials: a bench of two joints with effects hidden in it, with numpy alone.

`draw` makes sets of runs with what it hides; `motions` and `plant` are what it draws and integrates.
Nothing of the product is imported; sizes of effects come from `validation.diagnosis.entries`.
"""
