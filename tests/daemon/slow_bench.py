"""The shipped configuration with a slow SYNC, for tests of the daemon in which the loop's pace is not what is tried."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from jtqd.models.files import shipped


def slow_configuration(directory: Path, period_us: int, **sections: Any) -> Path:
    """Write it to `directory`/c.yaml; sections: those that are replaced."""
    content = {**yaml.safe_load(shipped("bench.yaml").read_text()), **sections}
    content["sync"]["period_us"] = period_us
    for joint in ("joint_1", "joint_2"):
        content[joint]["file"] = str(shipped(content[joint]["file"]))
        if "network" in content[joint]:
            content[joint]["network"]["file"] = str(shipped(content[joint]["network"]["file"]))
    path = directory / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    return path
