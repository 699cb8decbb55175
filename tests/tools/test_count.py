"""The counter of lines and words: each file is in one package, and private words are found however they are written."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import count


def test_every_file_of_the_product_is_counted_once() -> None:
    names, found = count.product(), count.sizes()
    assert len(names) == len(set(names)) == sum(each.files for each in found.values())
    assert count.size(names).lines == sum(each.lines for each in found.values())
    assert not [name for name in names if name.startswith(("src/jtqd/daemon", "tests/", "validation/"))]
    assert {"examples", "tools", "src", "daemon/core"} <= set(found)


@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("daemon/core/cycle.pyx", "daemon/core"),
        ("daemon/jtq.py", "daemon"),
        ("sysid/score/command.py", "sysid/score"),
        ("sysid/plot.py", "sysid"),
        ("estimator/effects/cogging.py", "estimator"),
        ("tools/count.py", "tools"),
    ],
)
def test_a_file_belongs_to_the_longest_name_of_the_table(name: str, package: str) -> None:
    assert count.package_of(name) == package


def test_private_words_are_found_in_prose_and_identifiers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(count, "ROOT", tmp_path)
    lines = [
        "what it told us",
        "left_over = as_told",
        "# is left",
        "# over, of nowhere, foretold",
        "odd-runs; Says",
    ]
    (tmp_path / "a.py").write_text("\n".join(lines))
    found = [(word, number) for word, _, number, _ in count.places(["a.py"])]
    assert sorted(found) == [
        *(("left over", 2), ("left over", 3), ("odd run", 5), ("says", 5), ("told", 1), ("told", 2))
    ]
