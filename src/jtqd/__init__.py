"""jtqd: joint torque estimator daemon for harmonic-drive joints on CANopen, and the toolbox around it.

The packages stand at the top level of the source tree (`daemon/` is `jtqd.daemon`); links beside this file give them one name.
"""

__version__ = "0.2.0"
