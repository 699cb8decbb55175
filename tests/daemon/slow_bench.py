"""The shipped configuration with a slow SYNC, for tests of the daemon in which the loop's pace is not what is tried."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tests.shipped_bench import shipped_bench


def slow_configuration(directory: Path, period_us: int, **sections: Any) -> Path:
    """Write it to `directory`/c.yaml; sections: those that are replaced."""
    content = {**shipped_bench(), **sections}
    content["sync"]["period_us"] = period_us
    path = directory / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    return path
