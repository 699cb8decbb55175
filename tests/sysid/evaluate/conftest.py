"""One small bench of models and runs for all tests of `jtq evaluate`; no test changes it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.sysid.evaluate.evaluate_helpers import make_bench


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bench(tmp_path_factory.mktemp("evaluate"))


@pytest.fixture
def models(bench: Path, tmp_path: Path) -> Path:
    """A copy of the models that a test may change."""
    return Path(shutil.copytree(bench / "models", tmp_path / "models"))


@pytest.fixture(scope="session")
def one(bench: Path) -> Path:
    """A run at variable velocity."""
    return bench / "runs" / "variable_1.csv.gz"


@pytest.fixture(scope="session")
def two(bench: Path) -> Path:
    """Another one."""
    return bench / "runs" / "variable_2.csv.gz"
