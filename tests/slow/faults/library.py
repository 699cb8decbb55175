"""The cases with nodes of the `canopen` library (tests/library_drives): which make sense with them, and what is otherwise.

These nodes are strict: a SYNC of another length than 1019h tells is 8240h, and an error of communication takes them out of
operational until a reset. Their SYNC has no counter, as a drive's after its power-up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from tests.slow.faults import acts
from tests.slow.faults.case import STALE, STARTING, Case, codes
from tests.slow.faults.injections import Added

LEFT_OUT: Mapping[str, str] = {
    "13b": "their SYNC has no counter",
    "28b": "they have no 1020h",
}
"""Case -> why it is not played with them."""

_AFTER_A_RESET_MS = 1800.0
"""They answer a SYNC with data by 8240h and stay pre-operational until they are reset."""
_OTHERWISE: Mapping[str, Mapping[str, Any]] = {
    "12": {"recover_ms": _AFTER_A_RESET_MS},
    "13a": {
        "one": STALE | STARTING,
        "two": STALE | STARTING,
        "may": codes("8250"),
        "recover_ms": _AFTER_A_RESET_MS,
    },
    "28": {"fault": lambda: Added(first=acts.reconfigure_by_the_rules)},
}
"""Case -> fields that are otherwise with them."""


def with_library(cases: Iterable[Case]) -> list[Case]:
    """Return the cases as they are played with the nodes of the library."""
    return [replace(each, **_OTHERWISE.get(each.key, {})) for each in cases if each.key not in LEFT_OUT]
