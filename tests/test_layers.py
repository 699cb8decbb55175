"""Which package may import which, and how large it may be: the rules are the table of docs/architecture.md.

Imports are read from the sources. Those inside of functions and under TYPE_CHECKING count like all others, and so does what
a compiled module or its .pxd imports and cimports. Files and lines are counted as by `python -m tools.count`.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.paths import ROOT
from tools.count import PAGE, Size, packages, sizes

PACKAGES = ("daemon", "drivers", "estimator", "models", "sim_can", "sysid")


@cache
def rules() -> dict[str, tuple[frozenset[str], frozenset[str]]]:
    """Package -> (packages that it may import, libraries that it may import), from the table of the page."""
    return {
        name.replace("/", "."): (
            frozenset(each.replace("/", ".") for each in row.imports),
            row.libraries,
        )
        for name, row in packages().items()
    }


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules() -> dict[str, Path]:
    """Every module of the product, by its name without `jtqd.`; a .pxd alone is one as well."""
    return {
        name_of(path): path
        for package in PACKAGES
        for ending in ("*.pxd", "*.pyx", "*.py")
        for path in sorted((ROOT / package).rglob(ending))
    }


COMPILED = re.compile(
    r"^ *(?:from ([\w.]+) (?:import|cimport) (\([^)]*\)|[^\n]+)|(?:import|cimport) ([\w.]+))", re.MULTILINE
)
C_LIBRARIES = {"cython", "libc", "cpython", "posix"}
"""What comes with Cython itself."""


def compiled_imports(path: Path) -> Iterator[str]:
    """Full names of all that a compiled module imports, its .pxd included."""
    for source in {path.with_suffix(".pyx"), path.with_suffix(".pxd")}:
        if not source.exists():
            continue
        for module, names, whole in COMPILED.findall(source.read_text()):
            if whole:
                yield whole
            for name in re.findall(r"(\w+)(?: as \w+)?", names.partition("#")[0]):
                full = f"{module}.{name}"
                yield full if full.removeprefix("jtqd.") in modules() else module


@cache
def imports(name: str) -> frozenset[str]:
    """Full names of all that a module imports, wherever in it."""
    if modules()[name].suffix != ".py":
        return frozenset(
            each for each in compiled_imports(modules()[name]) if each.partition(".")[0] not in C_LIBRARIES
        )
    found: set[str] = set()
    for node in ast.walk(ast.parse(modules()[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name}: a relative import"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full.removeprefix("jtqd.") in modules() else str(node.module))
    return frozenset(found)


def of_project(name: str) -> Iterator[str]:
    """Modules of the project that a module imports, without `jtqd.`; each package's own name is not one of them."""
    for each in imports(name):
        inside = each.removeprefix("jtqd.")
        if inside != each and inside in modules() and inside != name:
            yield inside


def package_of(name: str) -> str:
    """The longest name of the table that the module lies in."""
    fitting = [each for each in rules() if name == each or name.startswith(each + ".")]
    assert fitting, f"{name} lies in no package of {PAGE.name}"
    return max(fitting, key=len)


def test_every_package_of_the_table_is_there() -> None:
    assert len(rules()) > 15
    for package, (allowed, _) in rules().items():
        assert any(name == package or name.startswith(package + ".") for name in modules()), package
        assert allowed <= set(rules()), f"{package}: {sorted(allowed - set(rules()))} are no packages"


@pytest.mark.parametrize("package", sorted(packages()))
def test_a_package_is_not_above_its_row(package: str) -> None:
    """A bound may be raised in a commit of its own, with the reason in the row."""
    row, found = packages()[package], sizes().get(package, Size(0, 0))
    assert row.files > 0 < row.lines, f"{package}: its row of {PAGE.name} has no bounds of files and lines"
    assert found.files <= row.files, f"{package}: found {found.files} files, expected at most {row.files}"
    assert found.lines <= row.lines, f"{package}: found {found.lines} lines, expected at most {row.lines}"


@pytest.mark.parametrize("package", sorted(rules()))
def test_a_package_imports_only_what_the_table_allows(package: str) -> None:
    allowed, libraries = rules()[package]
    wrong = []
    for name in modules():
        if package_of(name) != package:
            continue
        wrong += [
            f"{name} -> {each}" for each in of_project(name) if package_of(each) not in {package, *allowed}
        ]
        tops = {each.partition(".")[0] for each in imports(name)} - {"jtqd"} - set(sys.stdlib_module_names)
        wrong += [f"{name} -> {top}" for top in sorted(tops - libraries)]
    assert not wrong, "\n".join(wrong)


def test_no_circles() -> None:
    """Depth-first search; the first circle is named from its first module to its first module."""
    done: set[str] = set()

    def follow(name: str, path: list[str]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for each in of_project(name):
                follow(each, [*path, name])
            done.add(name)

    for name in modules():
        follow(name, [])


@pytest.mark.parametrize(
    ("module", "unwanted"),
    [
        (
            "daemon.supervisor.process",
            {"numpy", "onnxruntime", "canopen", "can", "mcap.writer", "zstandard", "_hashlib", "cyclonedds"},
        ),
        (
            "daemon.loop.process",
            {"onnxruntime", "canopen", "can", "mcap", "rich", "argparse", "_hashlib", "cyclonedds"},
        ),
        ("sim_can.bench", {"onnxruntime", "canopen", "can", "_hashlib"}),
        ("sim_can.plant_source", {"numpy", "onnxruntime"}),
    ],
)
def test_a_process_loads_no_library_that_it_does_not_use(module: str, unwanted: set[str]) -> None:
    """Each costs memory as long as jtqd runs: numpy 11 MB, OpenSSL 3.4, ONNX Runtime 35. Recorder: own test."""
    code = f"import sys, jtqd.{module}; print(*{unwanted!r} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "\n"


def test_one_import_name() -> None:
    """Nothing is imported by a folder's bare name: `daemon` may be somebody else's package."""
    for name in modules():
        tops = {each.partition(".")[0] for each in imports(name)}
        assert not tops & set(PACKAGES), f"{name} imports {sorted(tops & set(PACKAGES))} without `jtqd.`"
    links = {path.name for path in (ROOT / "src" / "jtqd").iterdir() if path.is_symlink()}
    assert links == set(PACKAGES)


def test_every_package_has_what_it_is_for() -> None:
    for name, path in modules().items():
        if path.name == "__init__.py":
            lines = (ast.get_docstring(ast.parse(path.read_text())) or "").splitlines()
            assert len(lines) >= 3, (
                f"{name}: its __init__ has {len(lines)} lines of docstring, expected at least 3"
            )


def test_constants_of_compiled_modules_have_no_second_home() -> None:
    """What mypy reads of a compiled module names the type of a constant; its value stands in the .pyx."""
    twice = re.compile(r"^(\w+)(?:: Final(?:\[[^\]]*\])?)? = ", re.MULTILINE)
    assert {
        str(path.relative_to(ROOT)): found
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.pyi"))
        if (found := [name for name in twice.findall(path.read_text()) if name.isupper()])
    } == {}
