"""An estimator goes into flat blocks and comes out as one that goes on bit by bit as the first would have."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.blocks import EstimatorBlocks, blocks_of, estimator_of, made_of
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.sample import Estimator, PythonEstimator
from jtqd.estimator.settings import METHODS, EstimatorSettings
from tests.estimator.effects.effect_signals import extended
from tests.estimator.estimator_helpers import with_faults
from tests.estimator.fused_helpers import fused_joint, temperatures, twisted
from tests.estimator.test_extended_estimator import ALL, MOTOR_SIDE, network_for

SEED, COUNT = 5, 2400


def rows() -> list[tuple[float, ...]]:
    temperature = temperatures("steps", SEED, COUNT)
    degrees: FloatArray | list[float] = [math.nan] * COUNT if temperature is None else temperature.tolist()
    motion = with_faults(twisted(SEED, COUNT), SEED)
    return [(*row, celsius) for row, celsius in zip(motion.rows(), degrees, strict=True)]


def copied(estimator: Estimator) -> Estimator:
    """As another process would make it: the plain values by way of JSON, the blocks as bytes."""
    given = blocks_of(estimator)
    plain = json.loads(json.dumps(given.plain))
    return estimator_of(
        EstimatorBlocks(plain, tuple(memoryview(bytes(each)) for each in given.blocks)), made_of(plain)
    )


def joints() -> dict[str, Joint]:
    everything = [(name, p) for name, p in ALL.items()]
    motor = ("encoder_eccentricity", {"amplitude_rad": 5e-3, "phase_rad": 0.3, "motor_side": 1.0})
    return {
        "plain": fused_joint(),
        "without torsion": fused_joint(torsion=None),
        "all effects": extended(fused_joint(), *everything),
        MOTOR_SIDE: extended(fused_joint(), motor, ("hysteresis", ALL["hysteresis"])),
    }


@pytest.mark.parametrize("before", [0, 1, 700, 1501])
@pytest.mark.parametrize("name", joints())
@pytest.mark.parametrize("method", METHODS)
def test_a_copy_goes_on_as_the_first_one_would_have(method: str, name: str, before: int) -> None:
    joint, inputs = joints()[name], rows()
    first = make_estimator(joint, EstimatorSettings(method=method), network_for(method))
    for row in inputs[:before]:
        first.step(*row)
    second = copied(first)
    assert type(second) is type(first)
    assert (second.with_network, second.joint.name) == (first.with_network, joint.name)
    found, expected = ([each.step(*row) for row in inputs[before:]] for each in (second, first))
    assert str(found) == str(expected)  # every bit, NaN and all
    assert any(math.isfinite(each.torque_nm) for each in found)
    for each in (first, second):
        each.reset()
    assert str([second.step(*row) for row in inputs]) == str([first.step(*row) for row in inputs])


def test_the_copy_has_a_memory_of_its_own() -> None:
    joint = joints()["all effects"]
    first = make_estimator(joint, EstimatorSettings(method="fused"), network_for("fused"))
    inputs = rows()
    for row in inputs[:500]:
        first.step(*row)
    second, twin = copied(first), copied(first)
    expected = str([twin.step(*row) for row in inputs[500:700]])
    for row in inputs[700:]:
        first.step(*row)
    assert str([second.step(*row) for row in inputs[500:700]]) == expected


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("method", ["network", "fused"])
def test_a_block_of_another_layout_is_refused(method: str, number: int) -> None:
    estimator = make_estimator(joints()["all effects"], EstimatorSettings(method=method), network_for(method))
    given = blocks_of(estimator)
    for wrong in (given.blocks[number][:-8], bytes(given.blocks[number]) + bytes(8), b""):
        blocks = list(given.blocks)
        blocks[number] = wrong
        with pytest.raises(ValueError, match=r"found .*, expected"):
            estimator_of(replace(given, blocks=tuple(blocks)), made_of(given.plain))


def test_an_estimator_of_another_kind_is_refused() -> None:
    given = blocks_of(make_estimator(fused_joint(), EstimatorSettings(method="tob")))
    strange = replace(given, plain={**given.plain, "kind": "other"})
    with pytest.raises(ValueError, match="found an estimator of kind 'other'"):
        estimator_of(strange, made_of(given.plain))
    fused = replace(given, plain={**given.plain, "kind": "fused"})
    with pytest.raises(ValueError, match="found a block of"):
        estimator_of(fused, made_of(given.plain))


def test_what_is_not_in_its_blocks_alone_is_refused() -> None:
    class Network:
        """Not native: a stand-in for a graph that only its runtime evaluates."""

        joint, sigma_scale, name = fused_joint().name, (1.0,) * 4, "foreign"
        envelope: Any = None

        def run_one(self, *_: float) -> float:
            return 0.0

    Network.envelope = network_for("fused").envelope  # type: ignore[union-attr]
    foreign = make_estimator(fused_joint(), EstimatorSettings(method="fused"), Network())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="evaluated by its file's runtime"):
        blocks_of(foreign)
    with pytest.raises(ValueError, match="found a PythonEstimator"):
        blocks_of(PythonEstimator(foreign))
