"""Licences of everything that runs with jtqd, as a table: `python -m jtqd.daemon.cli.licences [--all]`.

Read from the metadata of what is installed here (importlib.metadata); docs/security.md holds its output. With --all also
what the extras of this environment bring.
"""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections.abc import Iterable

_NAME = re.compile(r"[A-Za-z0-9._-]+")
_CLASSIFIER = "License :: OSI Approved :: "


def needed(names: Iterable[str], *, extras: bool = False) -> dict[str, importlib.metadata.Distribution]:
    """What these distributions need to run, by name, themselves included; `extras`: as far as it is installed, too."""
    found: dict[str, importlib.metadata.Distribution] = {}
    waiting = list(names)
    while waiting:
        requirement = waiting.pop()
        match = _NAME.match(requirement)
        optional = "extra ==" in requirement
        if match is None or (optional and not extras):
            continue
        name = match[0].lower().replace("_", "-")
        if name in found:
            continue
        try:
            distribution = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # of another platform, or an extra that is not installed
        found[name] = distribution
        waiting += distribution.requires or []
        extras = False  # of the first ones only
    return dict(sorted(found.items()))


def licence_of(distribution: importlib.metadata.Distribution) -> str:
    """SPDX expression where there is one, else the classifiers, else the first line of the licence field."""
    metadata = distribution.metadata
    if "License-Expression" in metadata:
        return metadata["License-Expression"]
    classifiers = [
        each.removeprefix(_CLASSIFIER)
        for each in metadata.get_all("Classifier") or ()
        if each.startswith(_CLASSIFIER)
    ]
    field = metadata["License"].strip().splitlines() if "License" in metadata else []
    return ", ".join(classifiers) or (field[0] if field else "see its LICENSE file")


def table(*, extras: bool = False) -> str:
    """The table in Markdown."""
    rows = ["| package | version | licence |", "|---|---|---|"]
    for name, distribution in needed(["jtqd"], extras=extras).items():
        rows.append(f"| {name} | {distribution.version} | {licence_of(distribution)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table(extras="--all" in sys.argv[1:]))
