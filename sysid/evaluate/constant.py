"""Score every method at constant velocity and load, plateau by plateau (section IV.A), and ours outside its envelope.

Plateaus are detected in the data (sysid.fit.plateaus). Their means run over whole ripple periods, so that the error is
that of the loss and not the ripple.

Outside is defined by the network's own envelope of load and temperature: |motor torque| beyond the last cell of its map
that any speed has, or a temperature beyond the range of its training runs, independent of the published status.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.envelope import Envelope
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns
from jtqd.estimator.status import DEGRADED
from jtqd.sysid.evaluate.methods import OURS, Samples
from jtqd.sysid.evaluate.scores import Block, Score, score
from jtqd.sysid.fit.plateaus import Plateau, PlateauError, find_plateaus

PAPER_WORST_PERCENT: Final = 27.6
"""Classical TOB, back drive, 2.5 rad/s, 30 Nm (section IV.A)."""
WORST_VELOCITY_RAD_S: Final = (2.4, 2.6)
WORST_TORQUE_NM: Final = (25.0, 35.0)
"""What counts as "2.5 rad/s and 30 Nm": no plateau has just that torque, because currents are commanded."""

NO_LOAD: Final = 0.05
"""Share of rated torque below which an error relative to the torque has no meaning."""
WHOLE: Final = 0.9
"""Share of a plateau's samples at which every method must have a value."""
CONSTANT_SHARE: Final = 0.25
"""Share of a run's moving time in plateaus from which on the run is one at constant velocity."""
_MOVING_RAD_S: Final = 0.05


class PlateauScore(NamedTuple):
    """One plateau of one joint; drive: forward or back, as this joint sees it; errors: mean error by method [Nm]."""

    run: str
    number: int
    start_s: float
    end_s: float
    drive: str
    velocity_rad_s: float
    current_a: float
    torque_nm: float
    rated_nm: float
    errors_nm: Mapping[str, float]

    def percent(self, method: str) -> float | None:
        """Error in percent of the plateau's torque; None next to no load."""
        if abs(self.torque_nm) < NO_LOAD * self.rated_nm:
            return None
        return 100.0 * abs(self.errors_nm[method]) / abs(self.torque_nm)

    def rated_percent(self, method: str) -> float:
        """Error in percent of rated torque."""
        return 100.0 * abs(self.errors_nm[method]) / self.rated_nm


def plateaus_of(name: str, time_s: np.ndarray, columns: JointColumns, joint: Joint) -> list[Plateau]:
    """Return the plateaus of a joint in a run; none where nothing settled."""
    try:
        return find_plateaus(time_s, columns, joint, name)
    except PlateauError:
        return []


def is_constant(plateaus: Sequence[Plateau], samples: Samples) -> bool:
    """Return whether a run is at constant velocity: plateaus take a large share of its moving time."""
    speed = np.abs(np.nan_to_num(samples.velocity_rad_s))
    steps = np.diff(samples.time_s, prepend=samples.time_s[0])
    moving_s = float(np.sum(steps[speed > _MOVING_RAD_S]))
    return moving_s > 0.0 and sum(p.end_s - p.start_s for p in plateaus) >= CONSTANT_SHARE * moving_s


def plateau_scores(plateaus: Iterable[Plateau], samples: Samples) -> tuple[list[PlateauScore], list[str]]:
    """Return the scores of the plateaus of a run, and one line for each plateau at which a method had no value."""
    found, lost = [], []
    for plateau in plateaus:
        inside = slice(*np.searchsorted(samples.time_s, (plateau.start_s, plateau.end_s)).tolist())
        kept = samples.scored[inside]
        share = float(np.mean(kept)) if len(kept) else 0.0
        if share < WHOLE:
            lost.append(
                f"{samples.run}: j{samples.number}: found a value of every method at {100 * share:.0f} % of the plateau "
                f"from {plateau.start_s:.2f} to {plateau.end_s:.2f} s, expected {100 * WHOLE:.0f} %: plateau not scored"
            )
            continue
        found.append(
            PlateauScore(
                samples.run,
                samples.number,
                plateau.start_s,
                plateau.end_s,
                "forward" if plateau.current.value * plateau.velocity.value > 0.0 else "back",
                plateau.velocity.value,
                plateau.current.value,
                float(np.mean(samples.sensor_nm[inside][kept])),
                samples.rated_nm,
                {
                    method: float(np.mean(samples.error_nm(method)[inside][kept]))
                    for method in samples.estimate_nm
                },
            )
        )
    return found, lost


def hardest(plateaus: Iterable[PlateauScore]) -> list[PlateauScore]:
    """Return the back-driven plateaus at about 2.5 rad/s and 30 Nm, where the paper's TOB is worst."""
    return [
        each
        for each in plateaus
        if each.drive == "back"
        and WORST_VELOCITY_RAD_S[0] <= abs(each.velocity_rad_s) <= WORST_VELOCITY_RAD_S[1]
        and WORST_TORQUE_NM[0] <= abs(each.torque_nm) <= WORST_TORQUE_NM[1]
    ]


def worst(
    plateaus: Iterable[PlateauScore], method: str, size: Callable[[PlateauScore, str], float | None]
) -> tuple[float, PlateauScore] | None:
    """Return the largest `size(plateau, method)` and its plateau; None where no plateau has one."""
    sized = [
        (value, each)
        for each in plateaus
        if method in each.errors_nm and (value := size(each, method)) is not None
    ]
    return max(sized, key=lambda item: item[0], default=None)


def speed_groups(plateaus: Iterable[PlateauScore]) -> dict[tuple[str, float], list[PlateauScore]]:
    """Return the plateaus by drive and |velocity| rounded to 0.1 rad/s; forward first, slow first."""
    groups: dict[tuple[str, float], list[PlateauScore]] = {}
    for each in plateaus:
        groups.setdefault((each.drive, round(abs(each.velocity_rad_s), 1)), []).append(each)
    return dict(sorted(groups.items(), key=lambda item: (item[0][0] != "forward", item[0][1])))


class Range(NamedTuple):
    """Training range of a joint: motor torque, joint side [Nm], and temperature [degC], None where it had none."""

    torque_nm: tuple[float, float]
    temperature_c: tuple[float, float] | None


class Outside(NamedTuple):
    """Samples of one joint outside: how many of how many scored; ours and physics-only; share flagged degraded.

    physics: None where no network is there, so that ours is its physics.
    by_load, by_temperature: samples beyond that limit (some are beyond both).
    """

    number: int
    range: Range
    samples: int
    of: int
    by_load: int
    by_temperature: int
    ours: Score
    physics: Score | None
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
        own = [each for each in samples if each.number == number and OURS in each.estimate_nm]
        limits = training_range(envelope)
        beyonds = [beyond(each, limits) for each in own]
        masks = [each.scored & (load | warm) for each, (load, warm) in zip(own, beyonds, strict=True)]
        pairs = list(zip(own, masks, strict=True))
        ours = score([Block(each.error_nm(OURS)[mask], each.rated_nm) for each, mask in pairs])
        if ours is None:
            continue
        bare = all("physics" in each.estimate_nm for each in own)
        physics = score(
            [Block(each.error_nm("physics")[mask], each.rated_nm) for each, mask in pairs if bare]
        )
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
