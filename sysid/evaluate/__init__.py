"""Compare every method with the torque sensor on runs that no model was made from: `jtq evaluate`.

In: runs, a directory of models. Out: table, evaluation.json, evaluation.html. Modules: `command`, `inputs` (runs that may be
used), `methods` (models and estimates), `scores`, `constant` (plateaus), `loop_time`, `evaluation` (all tables and targets),
`report`, `figures`; `card`, `card_figure`, `card_page` (accuracy card of one's own joint, `--card`). Imports estimator,
models, sysid.runs, sysid.fit, sysid.report.
"""

"""`jtq evaluate`: section IV of the paper, every method beside the torque sensor, on runs that no model has seen."""
