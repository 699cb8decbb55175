"""One small bench of models and runs for all tests of `jtq evaluate`; no test changes anything in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sysid.evaluate.evaluate_helpers import make_bench


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bench(tmp_path_factory.mktemp("evaluate"))
