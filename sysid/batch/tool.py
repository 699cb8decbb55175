"""What a result was made by: version of jtqd and a hash of its code, so that an edited tree is another tool."""

from __future__ import annotations

import hashlib
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

_PACKAGES: Final = (
    "jtqd.daemon",
    "jtqd.drivers",
    "jtqd.estimator",
    "jtqd.models",
    "jtqd.sim_can",
    "jtqd.sysid",
)
_CODE: Final = (".py", ".j2", ".css", ".eds")
"""Everything in the packages that takes part in a result; joint files and networks are parameters of the batch."""


def tool_version() -> str:
    """Version of jtqd on this machine and hash of its code as it is now, e.g. "0.1.0+code.3fa9c1d2e4b7"; takes 0.1 s.

    Raises PackageNotFoundError where jtqd is not installed.
    """
    return f"{version('jtqd')}+code.{code_hash()}"


def code_hash() -> str:
    """Hash of the files of code, by their names below the packages and their content."""
    found = hashlib.sha256()
    for package in _PACKAGES:
        spec = find_spec(package)
        for root in sorted(spec.submodule_search_locations or ()) if spec is not None else ():
            for path in sorted(Path(root).rglob("*")):
                if path.suffix in _CODE and path.is_file():
                    data = path.read_bytes()
                    name = f"{package}/{path.relative_to(root).as_posix()}"
                    found.update(f"{name} {len(data)}\n".encode() + data)
    return found.hexdigest()[:12]
