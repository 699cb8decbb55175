"""Damaged files of every kind: one clear line each time, within limits of time and memory; `make fuzz` has the long run."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.models.files import load_yaml
from tests.slow.fuzz.files import bombs, fuzz_files


def test_every_kind_of_file() -> None:
    reports = fuzz_files(seed=1, count=5)
    assert len(reports) == 14
    assert [line for report in reports for line in report.wrong] == []
    assert sum(report.counts["refused"] for report in reports) > 2 * len(reports)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", [1, 2])
def test_many_of_every_kind(seed: int) -> None:
    assert [line for report in fuzz_files(seed, 300) for line in report.wrong] == []


@pytest.mark.parametrize("name", sorted(bombs()))
def test_small_texts_that_explode(name: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_bytes(bombs()[name])
    begun = time.process_time()
    try:
        load_yaml(path)
    except ConfigError as error:
        lines = str(error).splitlines()
    else:
        lines = ["read"]
    assert len(lines) == 1
    assert time.process_time() - begun < 10.0


def test_merged_aliases_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_bytes(bombs()["merged aliases"])
    with pytest.raises(ConfigError, match="more than 10000 keys and values"):
        load_yaml(path)
