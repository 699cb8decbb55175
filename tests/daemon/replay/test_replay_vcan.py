"""A log of real SocketCAN, in exact time in the bench kernel, replayed bit for bit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.golden.scene import SCENES, play


@pytest.mark.socketcan
@pytest.mark.parametrize("name", ["faults", "network"])
def test_a_log_of_a_real_interface_comes_out_bit_for_bit(tmp_path: Path, name: str) -> None:
    """Also after a foreign SYNC, a conflict, a node that restarted and an interface that was down."""
    log = play(name, tmp_path)
    result = subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtq", "replay", str(log), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    (found,) = json.loads(result.stdout)["runs"]
    assert found["identity"]["identical"] == found["cycles"]
    assert found["identity"]["pdos"] == found["identity"]["pdos_equal"]
    assert found["cycles"] == pytest.approx(SCENES[name].seconds * 1e6 / SCENES[name].period_us, rel=0.1)
