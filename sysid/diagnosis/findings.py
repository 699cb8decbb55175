"""What a diagnosis says, as frozen values: the source of findings.json (schema jtq.findings/1), report and exit status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from estimator.friction import FloatArray

SCHEMA: Final = "jtq.findings/1"
NO_GAP: Final = "no_gap"
CAUSE: Final = "cause"
AMBIGUOUS: Final = "ambiguous"
UNEXPLAINED: Final = "unexplained"
INSUFFICIENT: Final = "insufficient_data"
VERDICTS: Final = (NO_GAP, CAUSE, AMBIGUOUS, UNEXPLAINED, INSUFFICIENT)

JointName = int | str
"""1 to 7, or "sensor"."""


@dataclass(frozen=True)
class Value:
    """A parameter with its 95 % interval."""

    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Cause:
    """One effect present. names: its class, itself first: what it cannot be told from on these runs."""

    name: str
    joint: JointName
    names: tuple[str, ...]
    parameters: Mapping[str, Value]
    delta_bic: float
    held_out_gain: float  # share of the held-out residual energy that it takes away
    rms_nm: float  # of its contribution over the runs, in the balance where it is largest
    balance: str  # "motor" or "torsion": where it is largest


@dataclass(frozen=True)
class Candidate:
    """Evidence of one effect against the baseline alone; why it was not chosen, and the smallest size detectable."""

    name: str
    joint: JointName
    delta_bic: float
    held_out_gain: float
    shared: float  # part of its column that the chosen causes share, 0 to 1; NaN without causes
    minimum: Mapping[str, Value]  # minimum detectable size of its leading parameter(s); value inf: invisible
    reason: str  # "chosen", "class of X", "below threshold", "invisible in these runs", "needs temperature_c", ...
    at_minimum: tuple[Mapping[str, float], ...] = ()  # all parameters at that size, per way of looking for it


@dataclass(frozen=True)
class Place:
    """Part `share` of the gap's excess energy lies in this bin. axis: velocity, load, current, quadrant, temperature,
    motor_angle, link_angle, time, frequency; low, high in `unit`.
    """

    axis: str
    bin: str
    share: float
    low: float
    high: float
    unit: str
    rms_nm: float = float("nan")


@dataclass(frozen=True)
class Gap:
    """One balance of one joint: residual of the simulation, noise floor, where it lives (largest share first).

    map: all bins of all axes, for the report's picture; localisation holds the few that matter.
    """

    joint: int
    balance: str
    rmse_nm: float
    noise_floor_nm: float
    floor_from: str  # "repeated runs" or "what no effect and no map can explain"
    localisation: tuple[Place, ...]
    map: tuple[Place, ...] = field(default=(), repr=False)


class RunGain(NamedTuple):
    """Error on one run, with the parameters of all other runs."""

    run: str
    rmse_before_nm: float
    rmse_after_nm: float


@dataclass(frozen=True)
class Gain:
    """Held-out error before and after, runs left out one by one; ci95: of rmse_before - rmse_after [Nm]."""

    rmse_before_nm: float
    rmse_after_nm: float
    split: str
    ci95: tuple[float, float]
    free_run_before: float = float("nan")  # rad/s, joint side
    free_run_after: float = float("nan")
    runs: tuple[RunGain, ...] = ()


@dataclass(frozen=True)
class Trace:
    """For plots: one run, one joint, one balance, binned; arrays [n]."""

    run: str
    joint: int
    balance: str
    time_s: FloatArray
    before_nm: FloatArray
    after_nm: FloatArray
    velocity_rad_s: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True)
class Findings:
    """All of it. gaps: largest excess first; causes: largest first; reasons: lines for people."""

    verdict: str
    reasons: tuple[str, ...]
    runs: tuple[str, ...]
    joints: tuple[int, ...]
    gaps: tuple[Gap, ...] = ()
    causes: tuple[Cause, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    gain: Gain | None = None
    channel_notes: tuple[str, ...] = ()
    next_experiment: Mapping[str, Any] | None = None  # {"why": text, "plan": mapping of jtq.plan/1}
    traces: tuple[Trace, ...] = field(default=(), repr=False)
