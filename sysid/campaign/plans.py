"""The campaigns that come with the toolbox: efficiency, excitation, validate; whole or scaled down. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from sysid.campaign import constant_velocity as constant
from sysid.campaign import fourier_runs
from sysid.campaign.plan import DEFAULT_LIMITS, Plan, Run
from sysid.motion.limits import Limits

KINDS: Final = ("efficiency", "excitation", "validate")
_QUICK_VELOCITIES: Final = (0.4, 1.4, 2.4)
_QUICK_CURRENTS: Final = (1.0, 2.5, 4.0)


@dataclass(frozen=True)
class Scale:
    """How large a campaign is; None: as in the paper, or small with `quick`.

    Attributes:
        runs: number of Fourier runs. seconds: length of one. hold_s: of a point at constant velocity.
        seed: of the trajectories. evaluations: of the genetic algorithm, per trajectory.
        quick: a small campaign of the same kind: enough points for every fit, too few for a good one.
        limits: of the plan; the Fourier runs stay well within them.
    """

    runs: int | None = None
    seconds: float | None = None
    hold_s: float | None = None
    seed: int = 0
    evaluations: int | None = None
    quick: bool = False
    limits: Limits = DEFAULT_LIMITS

    def or_else(self, name: str, whole: Any, quick: Any) -> Any:
        """The value of an option: as given, else by the size of the campaign."""
        given = getattr(self, name)
        return given if given is not None else quick if self.quick else whole


def make_plan(kind: str, scale: Scale) -> Plan:
    """The plan of one of KINDS. Raises ConfigError for a scale that leaves nothing to be driven."""
    return Plan(kind, scale.limits, _MAKERS[kind](scale))


def _efficiency(scale: Scale) -> tuple[Run, ...]:
    hold_s = scale.or_else("hold_s", constant.HOLD_S, 1.0)
    if scale.quick:
        return constant.efficiency_runs(_QUICK_VELOCITIES, hold_s, _QUICK_CURRENTS)
    return constant.efficiency_runs(hold_s=hold_s)


def _excitation(scale: Scale) -> tuple[Run, ...]:
    return fourier_runs.excitation_runs(
        scale.limits,
        scale.or_else("runs", 24, 4),
        scale.or_else("seconds", 24.0, 10.0),
        scale.seed,
        scale.or_else("evaluations", 2000, 160),
    )


def _validate(scale: Scale) -> tuple[Run, ...]:
    return constant.validation_runs(
        scale.or_else("hold_s", constant.HOLD_S, 1.0)
    ) + fourier_runs.variable_runs(
        scale.limits, scale.or_else("runs", 24, 4), scale.or_else("seconds", 12.0, 6.0), scale.seed
    )


_MAKERS: Final = {"efficiency": _efficiency, "excitation": _excitation, "validate": _validate}
