"""Prints the tables of the profiles of drive families, with source and evidence of each line: `python -m tools.profiles`."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from jtqd.daemon.profiles import Family, Line, shipped


def table(family: Family) -> Iterator[str]:
    """Yield the lines of a family's table in docs/bus.md."""
    yield "| key | value | why | source | known |"
    yield "|---|---|---|---|---|"
    for line in family.lines:
        yield f"| {f'`{line.key}`' if line.key else ''} | {_value(line)} | {line.why} | {line.source} | {line.state} |"


def _value(line: Line) -> str:
    if line.check is not None:
        return f"{line.check} must be 0x{line.expected:08X}"
    if line.key is None:
        return ""
    if line.value is not None:
        if line.key.endswith(".index"):
            return f"0x{line.value:04X}"
        return f"{line.value:.8g}" if isinstance(line.value, float) else str(line.value)
    origin = line.read or (line.option or "").replace("_", " ")
    if line.inverse:
        return f"{line.factor:.8g} / {origin}"
    return origin if line.factor == 1.0 else f"{line.factor:g} x {origin}"


def main() -> int:
    """Print the tables."""
    for family in shipped():
        print(f"## {family.title}\n")
        print(f"`profile: {family.name}`, vendor-ID {family.vendor:08X}h.\n")
        print("\n".join(table(family)), end="\n\n")
        print("".join(f"Also: {text}.\n" for text in family.variants))
    return 0


if __name__ == "__main__":
    sys.exit(main())
