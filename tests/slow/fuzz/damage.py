"""Ways to damage a file: its bytes, and the tree of a YAML or JSON file."""

from __future__ import annotations

import copy
import random
from collections.abc import Iterator
from typing import Any

import yaml


def damage_bytes(source: random.Random, data: bytes) -> tuple[str, bytes]:
    kind = source.choice(("flip", "flips", "cut", "zeros", "noise", "repeat", "insert", "ends", "text"))
    out = bytearray(data)
    at = source.randrange(len(out) or 1)
    length = min(source.choice((1, 2, 8, 100, 3000)), len(out) - at)
    if kind == "flip":
        out[at] ^= 1 << source.randrange(8)
    elif kind == "flips":
        for _ in range(source.randrange(2, 50)):
            out[source.randrange(len(out))] = source.randrange(256)
    elif kind == "cut":
        del out[at:]
    elif kind == "zeros":
        out[at : at + length] = bytes(length)
    elif kind == "noise":
        out[at : at + length] = source.randbytes(length)
    elif kind == "repeat":
        out[at:at] = out[at : at + length] * source.choice((1, 3, 50))
    elif kind == "insert":
        out[at:at] = source.randbytes(source.choice((1, 4, 64)))
    elif kind == "ends":
        out = bytearray(source.choice((b"", b"\0", b"\xff" * 100, bytes(10_000), source.randbytes(1000))))
    else:
        word = source.choice(
            (b"\t", b"&a ", b"*a", b"!!python/object:os.system ", b"- ", b": ", b"\x85", b"0x", b"-1", b"nan")
        )
        out[at:at] = word
    return f"{kind} at {at}", bytes(out)


def bombs() -> dict[str, bytes]:
    """Small YAML texts that are large or endless where a reader is not careful."""
    lol = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9)
    )
    keys = ",".join(f"k{n}: 1" for n in range(500))
    merge = f"a: &a {{{keys}}}\n" + "".join(
        f"{chr(98 + n)}: &{chr(98 + n)} {{<<: [{','.join(['*' + chr(97 + n)] * 99)}]}}\n" for n in range(9)
    )
    return {
        "aliases": lol.encode(),
        "merged aliases": merge.encode(),
        "itself": b"a: &a\n  b: *a\n",
        "nested lists": b"a: " + b"[" * 20_000,
        "nested mappings": b"{a: " * 5_000,
        "indented": b"".join(b" " * n + b"a:\n" for n in range(1_000)),
        "digits": b"node_id: " + b"9" * 100_000,
        "sexagesimal": b"node_id: 1" + b":59" * 20_000,
        "documents": b"---\na: 1\n" * 1_000,
        "megabytes": b"# " + b"x" * 2_000_000,
        "python": b"a: !!python/object/apply:os.system ['true']\n",
    }


_HUGE = (10**400, -(10**400), 1e308, 5e-324, float("inf"), float("-inf"), float("nan"), -1, 0, 2**63, 1.5)


def _multiplied(levels: int) -> list[Any]:
    """A list of lists of the same lists: few objects, 9 ** levels values."""
    inner: list[Any] = ["x"]
    for _ in range(levels):
        inner = [inner] * 9
    return inner


_ODD = (
    _multiplied(9),
    None,
    True,
    False,
    "",
    "x" * 10_000,
    "nan",
    "1e400",
    "../../../dev/zero",
    "\0",
    [],
    {},
    [[]],
    {"a": 1},
    b"\0",
)


def _places(tree: Any, seen: set[int] | None = None) -> Iterator[tuple[Any, Any]]:
    """(container, key) of every value; what is in the tree twice is entered once."""
    seen = set() if seen is None else seen
    if id(tree) in seen:
        return
    seen.add(id(tree))
    for key, value in list(tree.items() if isinstance(tree, dict) else enumerate(tree)):
        yield tree, key
        if isinstance(value, dict | list):
            yield from _places(value, seen)


def damage_tree(source: random.Random, tree: Any, *, aliases: bool = True) -> tuple[str, Any]:
    """(what was done, the damaged tree): one to three values changed, removed, moved or nested.

    `aliases`: the file can say them.
    """
    out = copy.deepcopy(tree)
    said = []
    for _ in range(source.choice((1, 1, 1, 2, 3))):
        places = list(_places(out))
        if not places:
            break
        parent, key = source.choice(places)
        kind = source.choice(("huge", "odd", "remove", "swap", "nest", "unknown", "list"))
        said.append(f"{kind} {key}")
        if kind == "huge":
            parent[key] = source.choice(_HUGE)
        elif kind == "odd":
            parent[key] = copy.deepcopy(source.choice(_ODD[not aliases :]))
        elif kind == "remove":
            del parent[key]
        elif kind == "swap":
            other, name = source.choice(places)
            parent[key] = copy.deepcopy(other[name])
        elif kind == "nest":
            for _ in range(source.choice((1, 30))):
                parent[key] = [parent[key]] if source.random() < 0.5 else {"a": parent[key]}
        elif kind == "unknown" and isinstance(parent, dict):
            parent[source.choice(("x", "", 1, None, -0.5, "node_id"))] = 1
        else:
            parent[key] = [parent[key]] * source.choice((0, 2, 1000))
    return "; ".join(said), out


LARGEST = 100_000
"""Bytes of a damaged YAML file: PyYAML takes a second for 50 to 100 kB, and the reader's own limit is 1 MB."""


def damage_yaml(source: random.Random, data: bytes) -> tuple[str, bytes]:
    """Bytes of a YAML file, damaged in one way or the other."""
    chance = source.random()
    if chance < 0.1:
        name, text = source.choice(sorted(bombs().items()))
        return f"bomb: {name}", text
    if chance < 0.4:
        said, text = damage_bytes(source, data)
        return said, text[:LARGEST]
    said, tree = damage_tree(source, yaml.safe_load(data))
    return said, yaml.safe_dump(tree, sort_keys=False).encode()[:LARGEST]
