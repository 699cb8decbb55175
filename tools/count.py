"""Count files, lines and words of the source tree: `python -m tools.count`; `--words` lists the places of private words.

Lines are those of files as they stand, with headers and comments. Packages are the rows of the table in
docs/architecture.md, whose bounds tests/test_layers.py checks with the same counts.
"""

from __future__ import annotations

import argparse
import os
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[1]
PAGE: Final = ROOT / "docs" / "architecture.md"
OWN: Final = "tools/count.py"
PRODUCT: Final = (
    *("daemon", "drivers", "estimator", "models", "sysid", "sim_can"),
    *("src", "examples", "ros2", "tools"),
)
BESIDE: Final = ("validation", "tests")
ENDINGS: Final = frozenset((".py", ".pyx", ".pxd", ".pyi", ".j2", ".js"))
WORDS: Final = (
    *("told", "said", "says", "left over", "leftover", "anew", "whoever", "borne out", "of now"),
    *("odd run", "steadiness", "runs left out", "beside what"),
)
"""Words of the project's own dialect; each has a plain term of the field."""


class Package(NamedTuple):
    """A row of the table: name, packages and libraries that it may import, most files and lines (0: no bound)."""

    name: str
    imports: frozenset[str]
    libraries: frozenset[str]
    files: int
    lines: int


class Size(NamedTuple):
    """Number of files and of their lines."""

    files: int
    lines: int


@cache
def packages() -> dict[str, Package]:
    """Return the rows of the table in docs/architecture.md by name."""
    found = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        name = re.fullmatch(r"`([a-z0-9_./]+)`", cells[0])
        if name is not None and len(cells) in (4, 6):
            imports, libraries = (frozenset(re.findall(r"`([^`]+)`", cell)) for cell in cells[2:4])
            bounds = [int(cell) for cell in cells[4:]] or [0, 0]
            found[name[1]] = Package(name[1], imports, libraries, *bounds)
    return found


def files(folder: str) -> Iterator[str]:
    """Yield the source files below a folder of the tree, as paths relative to the tree; links are not followed."""
    for place, folders, names in os.walk(ROOT / folder):
        folders[:] = sorted(each for each in folders if each not in ("__pycache__", "build"))
        for name in sorted(names):
            if Path(name).suffix in ENDINGS:
                yield (Path(place) / name).relative_to(ROOT).as_posix()


def size(names: list[str]) -> Size:
    """Return the size of some files of the tree."""
    return Size(len(names), sum((ROOT / name).read_bytes().count(b"\n") for name in names))


def package_of(name: str) -> str:
    """Return the package that a file lies in: the longest name of the table, else its top folder."""
    stem = name.rpartition(".")[0]
    fitting = [each for each in packages() if f"{stem}/".startswith(f"{each}/")]
    return max(fitting, key=len, default=name.partition("/")[0])


def sizes() -> dict[str, Size]:
    """Return the size of every package of the product."""
    by_package: dict[str, list[str]] = {}
    for name in product():
        by_package.setdefault(package_of(name), []).append(name)
    return {name: size(own) for name, own in by_package.items()}


def pages() -> list[str]:
    """Return the pages of the documentation."""
    return ["README.md", *(f"docs/{page.name}" for page in sorted((ROOT / "docs").glob("*.md")))]


def places(names: list[str]) -> Iterator[tuple[str, str, int, str]]:
    """Yield (word, file, line number, line) of each private word in some files, in identifiers as well."""
    between = r"[\s_#-]+"
    looks = {
        word: re.compile(rf"(?<![a-z]){between.join(word.split())}s?(?![a-z])", re.IGNORECASE)
        for word in WORDS
    }
    for name in (each for each in names if each != OWN):
        text = (ROOT / name).read_text(encoding="utf-8")
        lines = text.splitlines()
        for word, look in looks.items():
            for found in look.finditer(text):
                number = text.count("\n", 0, found.start()) + 1
                yield word, name, number, lines[number - 1].strip()


def product() -> list[str]:
    """Return the source files of the product."""
    return [name for folder in PRODUCT for name in files(folder)]


def rows() -> list[tuple[str, str, str]]:
    """Return the table: packages with files and lines, pages with words, private words in product and pages."""
    parts = {**dict(sorted(sizes().items())), "product": size(product())}
    parts |= {folder: size(list(files(folder))) for folder in BESIDE}
    table = [("package", "files", "lines")]
    table += [(name, str(own.files), str(own.lines)) for name, own in parts.items()]
    words = sum(len((ROOT / page).read_text(encoding="utf-8").split()) for page in pages())
    table += [
        ("", "", ""),
        ("documentation", "pages", "words"),
        ("README.md, docs/*.md", str(len(pages())), str(words)),
    ]
    here, there = (Counter(word for word, *_ in places(names)) for names in (product(), pages()))
    table += [("", "", ""), ("private word", "product", "pages")]
    table += [(word, str(here[word]), str(there[word])) for word in WORDS]
    return [*table, ("all", str(here.total()), str(there.total()))]


def main() -> int:
    """Print the table, or the places of private words."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.count", description=(__doc__ or "").split("\n", 1)[0]
    )
    parser.add_argument("--words", action="store_true", help="list the places of private words")
    if parser.parse_args().words:
        for word, name, number, line in places([*product(), *pages()]):
            print(f"{name}:{number}: {word}: {line[:150]}")
        return 0
    for name, first, second in rows():
        print(f"{name:<24}{first:>8}{second:>8}".rstrip())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
