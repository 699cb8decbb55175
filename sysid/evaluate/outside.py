"""Outside of what our network was trained on: is ours no worse than its physics there, and does it say so? Pure.

Outside is what the network's own envelope calls so, by load and temperature: |motor torque| beyond the last cell of
its map that any speed has, or a temperature beyond the range of its training runs. The status, which is what is judged,
has no part in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.fused_trust import Envelope
from estimator.status import DEGRADED
from sysid.evaluate.methods import OURS
from sysid.evaluate.samples import Samples
from sysid.evaluate.score import Block, Score, score

FLAGGED: Final = 0.95
"""Share of samples outside whose status must say degraded."""


class Range(NamedTuple):
    """Training range of a joint: motor torque, joint side [Nm], and temperature [degC], None where it had none."""

    torque_nm: tuple[float, float]
    temperature_c: tuple[float, float] | None


class Outside(NamedTuple):
    """Samples of one joint outside: how many of how many scored; ours and physics-only; share flagged degraded.

    by_load, by_temperature: samples beyond that limit (some are beyond both).
    """

    number: int
    range: Range
    samples: int
    of: int
    by_load: int
    by_temperature: int
    ours: Score
    physics: Score
    flagged: float


def training_range(envelope: Envelope) -> Range:
    """Return the range of load and temperature of an envelope; a cell reaches half a step beyond its middle."""
    table = np.array(envelope.known)
    columns = np.flatnonzero(table.any(axis=0)) - table.shape[1] // 2
    if not len(columns):
        return Range((0.0, 0.0), envelope.temperature_c)
    step = envelope.torque_step_nm
    return Range(
        (float((columns[0] - 0.5) * step), float((columns[-1] + 0.5) * step)), envelope.temperature_c
    )


def beyond(samples: Samples, limits: Range) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which samples [n] are beyond the range of load, and beyond that of temperature."""
    with np.errstate(invalid="ignore"):
        load = (samples.raw_nm < limits.torque_nm[0]) | (samples.raw_nm > limits.torque_nm[1])
        if limits.temperature_c is None:
            return load, np.zeros_like(load)
        low, high = limits.temperature_c
        return load, (samples.temperature_c < low) | (samples.temperature_c > high)


def outside_scores(samples: Sequence[Samples], envelopes: dict[int, Envelope]) -> list[Outside]:
    """Return the scores of each joint that has an envelope and samples outside of it."""
    found = []
    for number, envelope in sorted(envelopes.items()):
        own = [
            each for each in samples if each.number == number and {OURS, "physics"} <= set(each.estimate_nm)
        ]
        limits = training_range(envelope)
        beyonds = [beyond(each, limits) for each in own]
        masks = [each.scored & (load | warm) for each, (load, warm) in zip(own, beyonds, strict=True)]
        pairs = list(zip(own, masks, strict=True))
        ours = score([Block(each.error_nm(OURS)[mask], each.rated_nm) for each, mask in pairs])
        physics = score([Block(each.error_nm("physics")[mask], each.rated_nm) for each, mask in pairs])
        if ours is None or physics is None:
            continue
        status = np.concatenate([each.status[OURS][mask] for each, mask in pairs])
        found.append(
            Outside(
                number,
                limits,
                ours.samples,
                sum(int(np.count_nonzero(each.scored)) for each in own),
                sum(int(np.count_nonzero(m & load)) for m, (load, _) in zip(masks, beyonds, strict=True)),
                sum(int(np.count_nonzero(m & warm)) for m, (_, warm) in zip(masks, beyonds, strict=True)),
                ours,
                physics,
                float(np.mean(status == DEGRADED)),
            )
        )
    return found
