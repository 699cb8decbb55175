"""What README and docs/ name is there: files, modules, imports, links; and the examples of docs/api.md run as they stand."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import textwrap
from pathlib import Path

import pytest

from jtqd.estimator.effects import EFFECTS
from tests.paths import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
IDS = [page.name for page in PAGES]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
FILE = re.compile(
    r"`((?:daemon|drivers|estimator|examples|models|sim_can|sysid|systemd|tests|tools|validation)/[\w./-]*\.(?:py|pyx|pxd|yaml|sh|c|md|csv|csv\.gz|service))[:`]"
)
MODULE = re.compile(r"python -m ((?:jtqd|examples|tests|tools|validation)[\w.]*)")
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#]*)(#[^)]*)?\)")
IMPORT = re.compile(
    r"^ *(from (?:jtqd|examples)[\w.]* import (?:\([^)]*\)|[^\n]+)|import jtqd[\w.]*)", re.MULTILINE
)
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", [*PAGES, CONTRIBUTING], ids=[*IDS, CONTRIBUTING.name])
def test_files_and_links_are_there(page: Path) -> None:
    text = page.read_text()
    missing = [name for name in FILE.findall(text) if not (ROOT / name).exists()]
    missing += [link for link, _ in LINK.findall(text) if link and not (page.parent / link).exists()]
    assert not missing


def test_the_targets_that_a_contributor_is_told_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text()
    told = re.findall(r"^    make ([\w -]+?)(?:  |$)", CONTRIBUTING.read_text(), re.MULTILINE)
    assert len(told) >= 4
    assert [each for line in told for each in line.split() if f"\n{each}:" not in makefile] == []


HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Names of the headings of a page, as GitHub and mkdocs make them."""
    return {
        re.sub(r"[^\w\- ]", "", text.lower()).strip().replace(" ", "-")
        for text in HEADING.findall(page.read_text())
    }


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_every_link_ends_at_a_heading(page: Path) -> None:
    broken = [
        link + anchor
        for link, anchor in LINK.findall(page.read_text())
        if anchor and anchor[1:] not in anchors(page.parent / link if link else page)
    ]
    assert not broken


def test_the_table_of_effects_is_the_library() -> None:
    text = (ROOT / "docs" / "diagnosis.md").read_text().partition("## Effects")[2]
    rows = {
        group: re.findall(r"`(\w+)`", cell)
        for group, cell in re.findall(r"^\| (\w+) \| (`.*) \|$", text, re.MULTILINE)
    }
    groups: dict[str, set[str]] = {}
    for effect in EFFECTS.values():
        groups.setdefault(effect.group, set()).add(effect.name)
    assert {group: set(names) for group, names in rows.items()} == groups, "docs/diagnosis.md, Effects"


def test_the_documentation_is_short() -> None:
    """A reader finds an answer in minutes; details of a method stand in the docstring of its file."""
    assert len(PAGES) <= 16
    assert sum(len(page.read_text().split()) for page in PAGES) <= 30_600


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_modules_that_are_run_are_there(page: Path) -> None:
    for name in MODULE.findall(page.read_text()):
        path = ROOT / name.rstrip(".").removeprefix("jtqd.").replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), name


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_imports_are_there(page: Path) -> None:
    for line in IMPORT.findall(page.read_text()):
        (node,) = ast.parse(textwrap.dedent(line)).body
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.import_module(
                    f"{node.module}.{alias.name}"
                ), line


@pytest.mark.parametrize("number", range(len(BLOCK.findall((ROOT / "docs" / "api.md").read_text()))))
def test_the_examples_of_the_api_run(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each block alone, in an empty directory; what stands behind `#>` is what the line before it prints."""
    monkeypatch.chdir(tmp_path)
    code = BLOCK.findall((ROOT / "docs" / "api.md").read_text())[number]
    exec(
        compile(code, f"docs/api.md, example {number + 1}", "exec"),
        {"__name__": "example", "GOLDEN": ROOT / "tests" / "golden"},
    )
    expected = re.findall(r"# -> (.*)", code)
    assert capsys.readouterr().out.splitlines() == expected


PACKAGES = ("daemon", "drivers", "estimator", "models", "sim_can", "sysid")
WITH_EXAMPLES = [
    "jtqd." + ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
    if ">>> " in path.read_text()
]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_examples_of_docstrings_run(name: str) -> None:
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted
    assert not result.failed
