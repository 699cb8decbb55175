"""Which of the objects that a boot has read say what a node's numbers mean: its PDOs and its scaling. Pure.

They are read again in service (`daemon/master/configuration_watch.py`): where one has changed, the node's numbers mean
something else than before.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from drivers.devices import OPERATING_MODE_OBJECT, Key

_PDO_PARAMETERS = range(0x1800, 0x1C00)
"""Communication and mapping parameters of TPDOs (CiA 301)."""


def watched_objects(found: Mapping[Key, int], scaling: Collection[Key]) -> tuple[tuple[int, int, int], ...]:
    """(index, sub-index, value) of the objects in `found` that belong to a TPDO, to `scaling` or to a channel's mode."""
    return tuple(
        (*key, value)
        for key, value in sorted(found.items())
        if key[0] in _PDO_PARAMETERS or key[0] == OPERATING_MODE_OBJECT or key in scaling
    )
