"""An estimator as plain values: written by the process that has built it, put together by another one of that build.

    plain     kind, joint and settings as mappings, sizes of the blocks          a few hundred bytes of JSON
    blocks    parameters, state, and for a joint with effects their memory       flat, 70 to 100 kB

What is put together goes on as the original would, bit by bit, and has loaded no network and read no joint file. Its `joint`
holds neither efficiency nor section `fused` nor provenance: these are in its parameters.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from jtqd.estimator.corrections import ExtendedInputs, torsion_zero
from jtqd.estimator.estimator import ExtendedEstimator, FusedEstimator, JointEstimator
from jtqd.estimator.joint import Effect, Friction, Joint
from jtqd.estimator.sample import Estimator
from jtqd.estimator.settings import EstimatorSettings

_KINDS: Final[dict[str, type[JointEstimator] | type[FusedEstimator]]] = {
    "paper": JointEstimator,
    "fused": FusedEstimator,
}


@dataclass(frozen=True)
class EstimatorBlocks:
    """One estimator: `plain` as JSON takes it, `blocks` in the order parameters, state, memory."""

    plain: Mapping[str, Any]
    blocks: tuple[bytes | memoryview, ...]


@dataclass(frozen=True)
class MadeOf:
    """What an estimator of blocks was made of."""

    joint: Joint
    settings: EstimatorSettings


def blocks_of(estimator: Estimator) -> EstimatorBlocks:
    """Return what `estimator_of` needs.

    Raises ValueError for an estimator that is not in its blocks alone: with a network that is not evaluated natively, or
    not made by `methods.make_estimator`.
    """
    inner = estimator.inner if isinstance(estimator, ExtendedEstimator) else estimator
    if not isinstance(inner, JointEstimator | FusedEstimator):
        raise ValueError(f"found a {type(inner).__name__}, expected an estimator of `make_estimator`")
    memory, zero_rad = b"", None
    if isinstance(estimator, ExtendedEstimator):
        values = estimator.torque, *estimator.inputs.memory
        memory, zero_rad = struct.pack(f"<{len(values)}d", *values), torsion_zero(estimator.joint)
    plain = {
        "kind": next(name for name, kind in _KINDS.items() if isinstance(inner, kind)),
        "joint": replace(estimator.joint, efficiency=None, fused=None, provenance={}).to_mapping(),
        "settings": asdict(estimator.settings),
        "zero_rad": zero_rad,
    }
    return EstimatorBlocks(plain, (*inner.blocks(), memory))


def made_of(plain: Mapping[str, Any]) -> MadeOf:
    """Return joint and settings. Raises ConfigError."""
    given = plain["joint"]
    friction = Friction(**given["friction"])
    effects = tuple(Effect(**each) for each in given["effects"])
    # Not `Joint.from_mapping`, whose messages for whoever has written a file take three times as long.
    return MadeOf(
        Joint(**{**given, "friction": friction, "effects": effects}), EstimatorSettings(**plain["settings"])
    )


def estimator_of(given: EstimatorBlocks, made: MadeOf) -> Estimator:
    """Return the estimator; `made`: of `made_of`. Raises ValueError for blocks of another layout."""
    law, state, memory = given.blocks
    kind = _KINDS.get(given.plain["kind"])
    if kind is None:
        raise ValueError(f"found an estimator of kind {given.plain['kind']!r}, expected one of {[*_KINDS]}")
    inner = kind.of_blocks(made.joint, made.settings, law, state)
    zero_rad = given.plain["zero_rad"]
    if zero_rad is None:
        return inner
    if len(memory) % 8 or not memory:
        raise ValueError(f"found a memory of {len(memory)} bytes, expected numbers of 8 bytes")
    torque_nm, *values = struct.unpack(f"<{len(memory) // 8}d", memory)
    inputs = ExtendedInputs(made.joint, made.settings, zero_rad)
    inputs.memory = tuple(values)
    estimator = ExtendedEstimator(made.joint, made.settings, inner, inputs)
    estimator.torque = torque_nm
    return estimator
