"""The campaigns that come with the toolbox: efficiency, excitation, validate; whole or scaled down. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from sysid.campaign import constant_velocity as constant
from sysid.campaign import fourier_runs
from sysid.campaign.fourier_runs import Joints, Tried
from sysid.campaign.plan import DEFAULT_LIMITS, Plan, Run
from sysid.excitation_design import STARTS
from sysid.genetic import POPULATION
from sysid.motion.limits import Limits

KINDS: Final = ("efficiency", "excitation", "validate")
RUNS: Final = 24
QUICK_RUNS: Final = 4
EVALUATIONS: Final = 1000
QUICK_EVALUATIONS: Final = 160
_QUICK_VELOCITIES: Final = (0.4, 1.4, 2.4)
_QUICK_CURRENTS: Final = (1.0, 2.5, 4.0)


@dataclass(frozen=True)
class Scale:
    """How large a campaign is; None: as in the paper, or small with `quick`.

    Attributes:
        runs: number of Fourier runs. seconds: length of one. hold_s: of a point at constant velocity.
        seed: of the trajectories. evaluations: of each search of the genetic algorithm.
        quick: a small campaign of the same kind: enough points for every fit, too few for a good one.
        limits: of the plan; the Fourier runs stay well within them.
        joints: of the bench, for what a motion takes; None: those that ship.
    """

    runs: int | None = None
    seconds: float | None = None
    hold_s: float | None = None
    seed: int = 0
    evaluations: int | None = None
    quick: bool = False
    limits: Limits = DEFAULT_LIMITS
    joints: Joints = None

    def or_else(self, name: str, whole: Any, quick: Any) -> Any:
        """The value of an option: as given, else by the size of the campaign."""
        given = getattr(self, name)
        return given if given is not None else quick if self.quick else whole

    @property
    def motions_tried(self) -> int:
        """How many motions an excitation campaign tries before it begins."""
        evaluations: int = self.or_else("evaluations", EVALUATIONS, QUICK_EVALUATIONS)
        starts = STARTS if evaluations > POPULATION else 1
        runs: int = self.or_else("runs", RUNS, QUICK_RUNS)
        return 2 * runs * starts * evaluations


def make_plan(kind: str, scale: Scale, on_progress: Tried | None = None) -> Plan:
    """The plan of one of KINDS; on_progress is told how many motions were tried, `scale.motions_tried` in all.

    Raises:
        ConfigError: a scale that leaves nothing to be driven.
    """
    if kind == "efficiency":
        runs = _efficiency(scale)
    elif kind == "excitation":
        runs = _excitation(scale, on_progress)
    else:
        runs = _validate(scale)
    return Plan(kind, scale.limits, runs)


def _efficiency(scale: Scale) -> tuple[Run, ...]:
    hold_s = scale.or_else("hold_s", constant.HOLD_S, 1.0)
    if scale.quick:
        return constant.efficiency_runs(_QUICK_VELOCITIES, hold_s, _QUICK_CURRENTS, scale.limits.travel_rad)
    return constant.efficiency_runs(hold_s=hold_s, travel_rad=scale.limits.travel_rad)


def _excitation(scale: Scale, on_progress: Tried | None) -> tuple[Run, ...]:
    return fourier_runs.excitation_runs(
        scale.limits,
        scale.or_else("runs", RUNS, QUICK_RUNS),
        scale.or_else("seconds", 24.0, 10.0),
        seed=scale.seed,
        evaluations=scale.or_else("evaluations", EVALUATIONS, QUICK_EVALUATIONS),
        joints=scale.joints,
        on_progress=on_progress,
    )


def _validate(scale: Scale) -> tuple[Run, ...]:
    return constant.validation_runs(
        scale.or_else("hold_s", constant.HOLD_S, 1.0)
    ) + fourier_runs.variable_runs(
        scale.limits,
        scale.or_else("runs", RUNS, QUICK_RUNS),
        scale.or_else("seconds", 12.0, 6.0),
        seed=scale.seed,
        joints=scale.joints,
    )
