"""Compare every method with the torque sensor on runs that no model was made from: `jtq evaluate`.

In: runs, a directory of models. Out: table, evaluation.json, evaluation.html. Modules: `command`, `inputs` (models, runs,
estimates), `scores`, `evaluation` (all tables and targets), `report` (values, text, page), `card` (accuracy card, `--card`).
"""
