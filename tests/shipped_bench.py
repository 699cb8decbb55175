"""The shipped configurations as a mapping that can be changed and written anywhere."""

from __future__ import annotations

from typing import Any

import yaml

from jtqd.models.files import shipped


def shipped_bench(name: str = "bench.yaml") -> dict[str, Any]:
    """Return the content of bench.yaml or bench_paper.yaml, whose files have absolute paths."""
    content: dict[str, Any] = yaml.safe_load(shipped(name).read_text(encoding="utf-8"))
    for number in (1, 2):
        joint = content[f"joint_{number}"]
        for section in (joint, joint.get("network", {}), *joint.get("shadow_networks", {}).values()):
            if "file" in section:
                section["file"] = str(shipped(section["file"]))
    return content
