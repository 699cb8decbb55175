"""A joint file for those who simulate elsewhere: MJCF of MuJoCo, URDF.

In: a joint file with its effects. Out: text, and what of the file the format cannot say. Modules: `model` (pure), `command`.
"""
