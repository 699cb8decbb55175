"""jtqd: joint torque estimator daemon for harmonic-drive joints on CANopen, and the toolbox around it.

The packages stand at the top level of the source tree (`daemon/` is `jtqd.daemon`); links beside this file give them one name.
What a notebook needs of logs, runs and diagnosis is here as well, imported at its first use (docs/api.md).
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.2.0"

if TYPE_CHECKING:
    from jtqd.daemon.logs import read_attachments as read_attachments
    from jtqd.daemon.logs import read_topic as read_topic
    from jtqd.daemon.logs import topics_of as topics_of
    from jtqd.models.files import load_joint as load_joint
    from jtqd.sysid.diagnosis.run_files import diagnose as diagnose
    from jtqd.sysid.runs import read_runs as read_runs
else:
    _MODULES = {
        "diagnose": "sysid.diagnosis.run_files",
        "load_joint": "models.files",
        "read_attachments": "daemon.logs",
        "read_runs": "sysid.runs",
        "read_topic": "daemon.logs",
        "topics_of": "daemon.logs",
    }
    __all__ = list(_MODULES)

    def __getattr__(name):
        """Import a public name from its module at its first use."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
