"""Which values are said as bounds: those that the best fit puts beyond what is possible, no others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis import bounded
from jtqd.sysid.diagnosis.findings import BoundedValue, Cause
from tests.sysid.diagnosis.diagnose_core_helpers import candidates, dense, search_of
from tests.sysid.diagnosis.diagnose_helpers import COULOMB, OFFSET


@pytest.mark.parametrize("refused", [False, True])
@pytest.mark.parametrize(("of_file", "said"), [(-0.05, True), (0.05, False), (0.3, False)])
def test_only_a_best_value_that_is_not_possible_is_said_as_a_bound(
    monkeypatch: pytest.MonkeyPatch, of_file: float, said: bool, refused: bool
) -> None:
    """All else speaks for a bound: it falls on every run left out, the interval ends between zero and the file's value. That
    a guard refused the value as a cause, because it is at its limit, is no objection.
    """
    joint = load_joint(shipped("joint1.yaml"))
    [viscous] = candidates(joint, ("viscous_friction", 1, 0))
    file, one = (viscous.term.combine([x])["viscous_nms_per_rad"] for x in (0.0, 1.0))
    best = (of_file * file - file) / (one - file)
    x = 500.0 * np.random.default_rng(5).normal(size=(5, 60, 1))
    search = search_of(dense(5, [best], [0.1], columns=x), [viscous])

    if refused:
        search.rejected.add(viscous.key)

    class Falling:
        def __init__(self, *_: object) -> None:
            pass

        def squares(self, *_: object) -> list[dict[str, float]]:
            return [{"motor": 1.0}] * 5

        def squares_with(self, *_: object) -> list[dict[str, float]]:
            return [{"motor": 0.1}] * 5

    monkeypatch.setattr(bounded, "LeaveOneOut", Falling)
    value = SimpleNamespace(ci95=(-0.2 * file, 0.4 * file))
    monkeypatch.setattr(bounded, "values_of", lambda *_: {"viscous_nms_per_rad": value})
    dataset = SimpleNamespace(runs=[SimpleNamespace(name=f"run{k}") for k in range(5)])
    case = SimpleNamespace(search=search, dataset=dataset, fit=lambda h: h)
    found = cast("Any", SimpleNamespace(case=case))
    result = bounded._bounded(found, search.hypothesis(()), viscous, set())
    assert (result is not None) is said
    if result is not None:
        assert result.best == pytest.approx(of_file * file, rel=0.05)


def test_the_extended_file_takes_the_only_bound_of_a_joint_of_which_nothing_is_named() -> None:
    def of(name: str, joint: int = 1) -> BoundedValue:
        return BoundedValue(name, joint, "x", "Nm", 2.0, -0.1, 0.7, ())

    def taken(bounds: list[BoundedValue], *causes: Cause) -> list[bool]:
        return [bound.in_file for bound in bounded.in_the_file(bounds, causes)]

    viscous, coulomb, inertia = map(of, ("viscous_friction", "coulomb_friction", "rotor_inertia"))
    assert taken([viscous]) == [True]
    assert taken([viscous, of("coulomb_friction", 2)], COULOMB) == [True, False], "COULOMB is of joint 2"
    assert taken([viscous], OFFSET) == [False], "of the sensor"
    assert taken([viscous, coulomb]) == [False, False], "proven one by one, not together"
    assert taken([inertia]) == [False], "a rotor without inertia cannot be simulated"
    assert viscous.text.endswith("in the held-out runs")
    assert replace(viscous, in_file=True).text.endswith("; the extended joint file takes 0")
