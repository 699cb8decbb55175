"""The goals as one table: three plants, our estimate and its baselines, against the torque that only a plant knows.

| file | concept |
|---|---|
| `plants.py` | the plants, and one thing changed in them after identification |
| `identify.py` | campaigns on a plant and what is fitted to them; runs that judge, runs outside |
| `baselines.py` | least squares with a handful of coefficients |
| `judge.py` | every method over a run, beside the true torque |
| `figures.py` | a column: every figure of one plant |
| `table.py`, `__main__.py` | targets and text; the command |
"""
