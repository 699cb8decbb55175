"""The mutants of a compiled room, and where each of them acts."""

from __future__ import annotations

import json
from typing import NamedTuple

from tests.slow.mutants import ROOMS
from tests.slow.mutants.build import TABLES, TREE, module_of


class Mutant(NamedTuple):
    """One change; function: "" for a statement of the module; acts: numbers where it acts; names: set."""

    number: int
    file: str
    line: int
    column: int
    function: str
    change: str
    text: str
    acts: frozenset[int]
    names: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.change}: {self.text}"

    @property
    def key(self) -> str:
        """What names it in a list until its line is edited: file, function, source line, column and change."""
        return " | ".join((self.file, self.function, self.text, f"{self.column} {self.change}"))


def load(room: str) -> dict[int, Mutant]:
    """Read the table that the compilation of a room has left."""
    table = json.loads((TABLES / f"{module_of(room)}.json").read_text(encoding="utf-8"))
    lines = (TREE / ROOMS[room]).read_text(encoding="utf-8").splitlines()
    uses = {key: set(names) for key, names in table["uses"].items()}
    of_function: dict[str, set[int]] = {}
    for each in table["mutants"]:
        of_function.setdefault(each["function"], set()).add(each["number"])
    found = {}
    for each in table["mutants"]:
        number, line, acts = each["number"], each["line"], {each["number"]}
        if not each["function"]:
            acts = {n for name in functions_with(set(each["names"]), uses) for n in of_function.get(name, ())}
        found[number] = Mutant(
            number,
            ROOMS[room],
            line,
            each["column"] + 1,
            each["function"],
            each["change"],
            lines[line - 1].strip(),
            frozenset(acts),
            tuple(each["names"]),
        )
    return found


def functions_with(names: set[str], uses: dict[str, set[str]]) -> set[str]:
    """Return the functions that use a name of the module, or a name that is made of it."""
    known: set[str] = set()
    while names != known:
        known = set(names)
        for key, used in uses.items():
            if key.startswith("module ") and not key.endswith(" sets") and used & known:
                names = names | uses[f"{key} sets"]
    return {key for key, used in uses.items() if not key.startswith("module ") and used & names}
