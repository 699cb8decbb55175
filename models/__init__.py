"""Joint files, configurations, plant files and trained networks that ship, and the reader of all such files.

In come paths, out come a `Joint` or the plain mapping of a YAML file; errors are `ConfigError`s of one line. Imports
`jtqd.estimator` only.

>>> load_joint(shipped("joint1.yaml")).gear_ratio
100.0
"""

from jtqd.models.files import load_joint, load_yaml, read_yaml, shipped

__all__ = ["load_joint", "load_yaml", "read_yaml", "shipped"]
