"""The project's generator of trials: a bench of two joints with effects hidden in it, with numpy alone.

`draw` makes sets of runs with what it hides; `plant` has the motions that it draws and the equations that it integrates.
Nothing of the product is imported; sizes of effects come from `validation.diagnosis.entries`.
"""
