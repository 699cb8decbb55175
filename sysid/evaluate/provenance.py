"""Leakage guard: which runs the models were made from, by the hashes that models carry; a run among them judges nothing.

Joint files name them in `provenance` (every mapping of a section's `sha256`), networks in the metadata key `runs` and
in a card jointN.json or jointN.fused.json beside them.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from estimator.parameters import Joint

KEY: Final = "runs"
_COMPRESSION: Final = 6
"""Of run files as this toolbox writes them (sim_can.run_table_file)."""


@dataclass(frozen=True)
class TrainingRuns:
    """sources: SHA-256 of a run file -> names of the models made from it; silent: models that name no runs at all."""

    sources: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    silent: tuple[str, ...] = ()

    def and_those_of(self, other: TrainingRuns) -> TrainingRuns:
        """Return both together."""
        merged = dict(self.sources)
        for sha256, names in other.sources.items():
            merged[sha256] = tuple(dict.fromkeys((*merged.get(sha256, ()), *names)))
        return TrainingRuns(merged, tuple(dict.fromkeys((*self.silent, *other.silent))))


def joint_training_runs(name: str, joint: Joint) -> TrainingRuns:
    """Return the runs that sections of a joint file were fitted to; a file with nominal values has none, rightly."""
    sources: dict[str, tuple[str, ...]] = {}
    for section, record in joint.provenance.items():
        if isinstance(record, Mapping):
            for key in ("sha256", KEY):
                sources |= dict.fromkeys(_hashes(record.get(key)), (f"{name} ({section})",))
    return TrainingRuns(sources)


def network_training_runs(path: Path) -> TrainingRuns:
    """Return the runs that a network was trained on; one that does not say so is `silent`."""
    import onnx

    model = onnx.load_model(str(path), load_external_data=False)
    found = {entry.key: entry.value for entry in model.metadata_props}
    hashes = _hashes(_json(found.get(KEY, "")))
    card = path.with_suffix(".json")
    if card.is_file():
        content = _json(card.read_text(encoding="utf-8", errors="replace"))
        hashes |= _hashes(content.get(KEY) if isinstance(content, dict) else None)
    if not hashes:
        return TrainingRuns({}, (path.name,))
    return TrainingRuns(dict.fromkeys(hashes, (path.name,)))


def run_hashes(path: Path) -> tuple[str, ...]:
    """Return the SHA-256 of a run file, and that of the same data packed or unpacked: a copy is the same data."""
    data = path.read_bytes()
    hashes = [hashlib.sha256(data).hexdigest()]
    try:
        other = (
            gzip.decompress(data) if path.name.endswith(".gz") else gzip.compress(data, _COMPRESSION, mtime=0)
        )
    except (OSError, EOFError, zlib.error):  # not a run, as its reader will say
        return tuple(hashes)
    return (*hashes, hashlib.sha256(other).hexdigest())


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return None


def _hashes(value: Any) -> set[str]:
    """Hex SHA-256 in a mapping name -> hash or in a list; everything else is none."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if not isinstance(value, list):
        return set()
    return {text.lower() for text in value if isinstance(text, str) and len(text) == 64}
