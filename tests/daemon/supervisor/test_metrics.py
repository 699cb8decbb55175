"""The Prometheus text file: what is in it, and that no reader ever sees half of it."""

import re
from pathlib import Path

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.shared.conditions import WARNING, Condition
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.daemon.supervisor.service import metrics_text
from jtqd.estimator.errors import ConfigError
from jtqd.models.files import shipped
from tests.daemon.loop.cycle_helpers import inputs, make, turn

_LINE = re.compile(r'jtqd_[a-z0-9_]+\{bus="[^"]*"(,[a-z]+="[^"]*")?\} (-?[0-9.e+-]+|NaN|[+-]Inf)')


def text_of(tmp_path: Path, bus: str = "can0") -> str:
    cycle, _, _ = make(tmp_path, lambda _: inputs())
    turn(cycle, 40)
    reader = SnapshotReader(tmp_path / "snapshot")
    present = [Condition("stale_input", f"joint {n}", WARNING, "inputs lost: ...", 0) for n in (1, 2)]
    return metrics_text(reader.read(), reader, bus, 3, present)


def test_every_counter_and_both_joints_in_the_format_of_prometheus(tmp_path: Path) -> None:
    text = text_of(tmp_path)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert all(_LINE.fullmatch(line) for line in lines), [x for x in lines if not _LINE.fullmatch(x)]
    for name in COUNTERS:
        assert re.search(rf"^jtqd_{name}(_total)?\{{", text, re.MULTILINE), name
    assert 'jtqd_cycles_total{bus="can0"} 40' in lines
    assert 'jtqd_recorder_lost_total{bus="can0"} 3' in lines
    assert 'jtqd_status{bus="can0",joint="2"}' in text
    assert 'jtqd_condition{bus="can0",name="stale_input"} 2' in lines
    assert 'jtqd_condition{bus="can0",name="bus_off"} 0' in lines
    named = [line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")]
    assert len(named) == len(set(named))


def test_a_bus_may_have_any_name(tmp_path: Path) -> None:
    assert 'bus="unix-\\"a\\\\b"' in text_of(tmp_path, 'unix-"a\\b')


def test_it_is_off_unless_configured(tmp_path: Path) -> None:
    assert load_config(None).metrics_file is None
    for name in ("trained",):
        (tmp_path / name).symlink_to(shipped("bench.yaml").parent / name)
    text = shipped("bench.yaml").read_text()
    (tmp_path / "a.yaml").write_text(text + "metrics: {file: metrics.prom}\n")
    assert load_config(tmp_path / "a.yaml").metrics_file == Path("metrics.prom")
    (tmp_path / "b.yaml").write_text(text + "metrics: {fiel: metrics.prom}\n")
    with pytest.raises(ConfigError, match="metrics"):
        load_config(tmp_path / "b.yaml")
