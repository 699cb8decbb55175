"""What the estimator is given by ARM.yaml and by records, and the figures of a run."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.arm import process
from jtqd.daemon.arm.arm_file import load_arm
from jtqd.estimator.decoder import FieldError
from jtqd.estimator.status import VALID
from tests.daemon.arm import small_arm
from tests.daemon.arm.small_arm import NOTHING, record_of
from tests.daemon.arm.stub import EVERY, Stub

MS = 1_000_000


class Kept(Stub):
    """Keeps what it was made of."""

    def __init__(self, model: Any, period_s: float, *others: Any) -> None:
        super().__init__(model, period_s)
        self.others = others


def test_what_the_estimator_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = small_arm.content(
        payload={"mass_kg": 1.5, "centre_m": [0.0, 0.01, 0.1]},
        noise={
            "offset": 0.5,
            "total": {"elbow": 0.75, "shoulder": 1.25},
            "tests": {"elbow": [4.0, 5.0, 6.0], "shoulder": [1.0, 2.0, 3.0]},
            "position_rad": {"elbow": 2e-5, "shoulder": 1e-5},
        },
    )
    monkeypatch.setattr(process, "ArmEstimator", Kept)
    arm = process.Arm(load_arm(small_arm.write(tmp_path, content)))
    joint = NOTHING._replace(
        link_position_rad=0.5, torque_nm=10.0, sigma_nm=0.1, age_ms=5.0, status=int(VALID)
    )
    now = 10**12
    for source, period_us in zip(arm._sources, (1000, 2000), strict=True):
        source.about = SimpleNamespace(period_us=period_us, instance=source.bus)  # type: ignore[assignment]
    found = []
    for k in range(4 * EVERY):
        for source in arm._sources:
            made = [record_of(now + 2 * k * MS, joint)]
            monkeypatch.setattr(source, "read", lambda _now, made=made: made)
        found += list(arm.new(now + 2 * k * MS))
    estimator: Any = arm._estimator
    noise, payload = estimator.others
    assert estimator.period_s == pytest.approx(2e-3)
    assert (noise.total.tolist(), noise.offset) == ([1.25, 0.75], 0.5)
    assert noise.tests.tolist() == [[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]
    assert noise.position_rad.tolist() == [1e-5, 2e-5]
    assert (payload.mass_kg, payload.centre_m) == (1.5, (0.0, 0.01, 0.1))
    aligned, estimate, cycle = found[-1]
    assert aligned.position_rad == pytest.approx([0.25, -1.0])
    assert aligned.torque_nm == pytest.approx([10.0, -10.0])
    assert np.isfinite(estimate.external_nm).all()
    assert cycle == len(found) - 1
    summary = arm.summary()
    assert summary["cycles"] == len(found)
    assert summary["estimated"]["elbow"] == sum(np.isfinite(each.external_nm[1]) for _, each, _ in found)
    contacts = [each.contact for _, each, _ in found]
    assert summary["contacts"] == sum(b > a for a, b in pairwise(contacts)) > 2


def test_a_jtqd_that_comes_back_with_another_period_is_read_at_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(process, "ArmEstimator", Kept)
    arm = process.Arm(load_arm(small_arm.write(tmp_path)))
    joint = NOTHING._replace(
        link_position_rad=0.5, torque_nm=10.0, sigma_nm=0.1, age_ms=5.0, status=int(VALID)
    )
    now, first, second = 10**12, arm._sources[0], arm._sources[1]
    for periods_us in ((1000, 1000), (1000, None), (1000, 10_000)):
        for source, period_us in zip((first, second), periods_us, strict=True):
            source.about = (
                None if period_us is None else SimpleNamespace(period_us=period_us, instance=source.bus)
            )  # type: ignore[assignment]
        found = []
        for _ in range(200):
            now += MS
            for source, period_us in zip((first, second), periods_us, strict=True):
                due = period_us is not None and now // MS % (period_us // 1000) == 0
                made = [record_of(now, joint)] if due else []
                monkeypatch.setattr(source, "read", lambda _now, made=made: made)
            found += list(arm.new(now))
    assert arm._estimator.period_s == pytest.approx(10e-3)
    assert len(found) > 5
    assert all(np.isfinite(each.position_rad).all() for each, *_ in found[-5:])
    assert capsys.readouterr().err.count("begins again") == 1


def test_a_jtqd_under_two_names_is_refused(tmp_path: Path) -> None:
    arm = process.Arm(load_arm(small_arm.write(tmp_path)))
    for source in arm._sources:
        source.about = SimpleNamespace(period_us=1000, instance="vcan0")  # type: ignore[assignment]
        source._due_ns = 2 * 10**12
    with pytest.raises(FieldError) as error:
        list(arm.new(10**12))
    assert error.value.key == "joints"
    assert "one jtqd behind several of vcan0, vcan1" in str(error.value)
