"""Parameters of one joint as frozen values: what `joint.yaml` holds, checked in files and in code alike.

Stiffness, damping, link inertia and friction are joint side; torque constant and rotor inertia motor side. All torques
are joint side. Section `fused` is fitted by `jtq fit losses`; in it, `load` is the motor's torque seen from the joint and
along the motion, x = sign(v) G Kt i_eff: positive when driving, negative when back-driven.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import Annotated, Any, Final

from jtqd.estimator.decoder import (
    FieldError,
    Text,
    below,
    check,
    choice,
    decode,
    limits,
    numbers_text,
    parsed,
)
from jtqd.estimator.effects import EFFECTS, checked_parameters
from jtqd.estimator.errors import Verbatim

CONVENTIONS: Final = ("joint_over_motor", "motor_over_joint")
"""eta = tau_j/(G Kt i), as in the paper's Table I; or eta = G Kt i/tau_j, its Eq. (6)."""
_CONVENTION_TEXT: Final = (
    "one of 'joint_over_motor' (eta = tau_j/(G Kt i), below 1 when driving: Table I) or "
    "'motor_over_joint' (eta = G Kt i/tau_j, above 1 when driving: Eq. 6)"
)
QUADRANTS: Final = ("i_pos_w_pos", "i_neg_w_neg", "i_neg_w_pos", "i_pos_w_neg")
"""Order of Table I: two driving quadrants, then two back-driving quadrants."""
MAX_NODES: Final = 64
"""Most numbers of a list in section `fused`."""
MAX_LINK_ORDERS: Final = 6
MAX_HARDENINGS: Final = 8
MAX_SLIPS: Final = 6
ZERO_LIMIT_RAD: Final = 2e-3
"""Torque of more than half the rated one on the shipped joints, and seven arc minutes: no encoder that is mounted well."""


@dataclass(frozen=True, slots=True)
class Friction:
    """Additive joint-side friction: Coulomb + viscous + Stribeck; negative values raise ConfigError."""

    coulomb_nm: Annotated[float, limits("Nm", ge=0.0)]
    viscous_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)]
    stribeck_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    stribeck_velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)] = 0.05

    def __post_init__(self) -> None:
        check(self, "friction")


@dataclass(frozen=True, slots=True)
class QuadrantPolynomial:
    """Eq. (8): eta = p00 + p10 i + p01 v + p20 i^2 + p11 i v + p02 v^2; signed i [A], v = omega_m/G."""

    p00: float
    p10: float
    p01: float
    p20: float
    p11: float
    p02: float
    rmse: Annotated[float, limits(ge=0.0)] = 0.0

    def __post_init__(self) -> None:
        check(self, "efficiency quadrant")

    def value(self, current_a: float, velocity_rad_s: float) -> float:
        """Return the polynomial itself, unbounded."""
        i, v = current_a, velocity_rad_s
        return self.p00 + self.p10 * i + self.p01 * v + self.p20 * i * i + self.p11 * i * v + self.p02 * v * v


@dataclass(frozen=True, slots=True)
class Efficiency:
    """Four quadrants of Eq. (8) in a named convention (see CONVENTIONS), without which its numbers mean nothing."""

    convention: Annotated[str, choice(CONVENTIONS, _CONVENTION_TEXT)]
    i_pos_w_pos: QuadrantPolynomial
    i_neg_w_neg: QuadrantPolynomial
    i_neg_w_pos: QuadrantPolynomial
    i_pos_w_neg: QuadrantPolynomial

    def __post_init__(self) -> None:
        check(self, "efficiency")


def _check_length(where: str, key: str, values: tuple[float, ...], count: int, other: str) -> None:
    if len(values) != count:
        expected = f"a list of {count} finite numbers, as many as {other}"
        raise FieldError(where, key, numbers_text(len(values)), expected)


@dataclass(frozen=True, slots=True)
class LossSide:
    """Loss while turning one way, per load node: constant + viscous |v| + quadratic v^2 [Nm], and a Stribeck peak.

    Friction takes energy: viscous and Stribeck parts are at least 0, and so is the loss at breakaway, constant + Stribeck.
    """

    constant_nm: Annotated[tuple[float, ...], limits("Nm")]
    viscous_nms_per_rad: Annotated[tuple[float, ...], limits("Nms/rad")]
    quadratic_nms2_per_rad2: Annotated[tuple[float, ...], limits("Nms2/rad2")]
    stribeck_nm: Annotated[float, limits("Nm", ge=0.0)]


@dataclass(frozen=True, slots=True)
class AdditiveLoss:
    """Loss as a function of load, speed, direction and temperature; piecewise linear in load, quadratic in speed.

    load_nodes_nm: increasing, the lists of both sides as long as it (else ConfigError); velocity_max_rad_s:
    fastest measured, faster counts as this; temperature_c: of the fit; thermal_viscous_nms_per_rad: friction
    that falls as exp(-viscous_per_k (T - temperature_c)). The ranges hold in files; a fit may look beyond them.
    """

    load_nodes_nm: Annotated[tuple[float, ...], limits("Nm", length=(2, MAX_NODES))]
    positive: LossSide
    negative: LossSide
    stribeck_velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    velocity_max_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    temperature_c: Annotated[float, limits("degC", ge=-60.0, le=200.0)]
    thermal_viscous_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)]
    viscous_per_k: Annotated[float, limits("1/K", ge=-0.1, le=0.1)]

    def __post_init__(self) -> None:
        nodes = self.load_nodes_nm
        if len(nodes) < 2 or not all(a < b for a, b in pairwise(nodes)):
            raise FieldError("fused.loss", "load_nodes_nm", list(nodes), "at least 2 rising numbers")
        for name in ("positive", "negative"):
            side = getattr(self, name)
            for key in ("constant_nm", "viscous_nms_per_rad", "quadratic_nms2_per_rad2"):
                _check_length("fused.loss", f"{name}.{key}", getattr(side, key), len(nodes), "load_nodes_nm")
            slowest = min(side.viscous_nms_per_rad)
            if slowest < 0.0:
                raise FieldError(
                    "fused.loss", f"{name}.viscous_nms_per_rad", slowest, "at least 0 Nms/rad at every load"
                )
            least = min(side.constant_nm)
            if least + side.stribeck_nm < 0.0:
                expected = f"at least -stribeck_nm ({-side.stribeck_nm:g} Nm): friction takes energy"
                raise FieldError("fused.loss", f"{name}.constant_nm", least, expected)


@dataclass(frozen=True, slots=True)
class Torsion:
    """Torque from both encoders: tau = K d + K3 d^3 + D d' + H z, d = theta_m/G - theta_l - zero - kinematic error [rad].

    z follows d through a Maxwell-slip element, dz = dd/travel held in [-1, 1]: elastic hysteresis of half width H.
    Kinematic error: sum over orders n per motor revolution of c cos(n theta_m) + s sin(n theta_m). What a joint may have
    beyond that, and files may leave out: link_orders_per_rev: the same over theta_l, error of the link encoder over its own
    turn; hardening: the spring is stiffer by hardening_nm_per_rad beyond |d| = hardening_rad, added up; slips_nm,
    slips_travel_rad: further slip elements; zero_limit_rad: a link encoder that is off by more on a
    day is defect. The ranges hold in files; a fit may look beyond them.
    """

    stiffness_nm_per_rad: Annotated[float, limits("Nm/rad", gt=0.0)]
    cubic_nm_per_rad3: Annotated[float, limits("Nm/rad3")]
    zero_rad: Annotated[float, limits("rad")]
    orders_per_motor_rev: Annotated[tuple[float, ...], limits("1/rev", length=(1, MAX_NODES))]
    cos_rad: Annotated[tuple[float, ...], limits("rad")]
    sin_rad: Annotated[tuple[float, ...], limits("rad")]
    hysteresis_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    hysteresis_travel_rad: Annotated[float, limits("rad", gt=0.0)] = 1e-4
    damping_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)] = 0.0
    link_orders_per_rev: Annotated[tuple[float, ...], limits("1/rev", length=(0, MAX_LINK_ORDERS))] = ()
    link_cos_rad: Annotated[tuple[float, ...], limits("rad")] = ()
    link_sin_rad: Annotated[tuple[float, ...], limits("rad")] = ()
    hardening_rad: Annotated[tuple[float, ...], limits("rad", length=(0, MAX_HARDENINGS))] = ()
    hardening_nm_per_rad: Annotated[tuple[float, ...], limits("Nm/rad")] = ()
    slips_nm: Annotated[tuple[float, ...], limits("Nm", length=(0, MAX_SLIPS))] = ()
    slips_travel_rad: Annotated[tuple[float, ...], limits("rad")] = ()
    zero_limit_rad: Annotated[float, limits("rad", gt=0.0)] = ZERO_LIMIT_RAD

    def __post_init__(self) -> None:
        for first, *others in (
            ("orders_per_motor_rev", "cos_rad", "sin_rad"),
            ("link_orders_per_rev", "link_cos_rad", "link_sin_rad"),
            ("hardening_rad", "hardening_nm_per_rad"),
            ("slips_nm", "slips_travel_rad"),
        ):
            for key in others:
                _check_length("fused.torsion", key, getattr(self, key), len(getattr(self, first)), first)
        for key, least in (("hardening_rad", 0.0), ("slips_nm", 0.0), ("slips_travel_rad", 1e-9)):
            if any(value < least for value in getattr(self, key)):
                expected = f"numbers {'>' if least else '>='} 0"
                raise FieldError("fused.torsion", key, list(getattr(self, key)), expected)


@dataclass(frozen=True, slots=True)
class FusedSigma:
    """Standard deviations of the two paths, found on runs that the fit had not seen.

    current path: current_nm, viscous_nms_per_rad |v|, load |tau_raw|, added as squares; torsion path:
    torsion_nm, torsion_load |tau|; reference_nm: of the torque sensor's zero from run to run, which every
    comparison contains. scale: factor per quadrant (QUADRANTS' order) so that the 90 % interval covers 90 %.
    current_nm, torsion_nm and scale must be > 0 (else ConfigError): two paths that are both exact have no
    weights (0/0).
    """

    current_nm: Annotated[float, limits("Nm", gt=0.0)]
    viscous_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)]
    load: Annotated[float, limits(ge=0.0)]
    torsion_nm: Annotated[float, limits("Nm", gt=0.0)]
    torsion_load: Annotated[float, limits(ge=0.0)]
    reference_nm: Annotated[float, limits("Nm", ge=0.0)]
    scale: Annotated[tuple[float, float, float, float], limits()]

    def __post_init__(self) -> None:
        check(self, "fused.sigma")
        if not min(self.scale) > 0.0:
            raise FieldError("fused.sigma", "scale", list(self.scale), "4 numbers > 0")


TURN_WAVES: Final = 6
"""Cos and sin of 1, 2 and 4 times the motor's angle, in this order."""


@dataclass(frozen=True, slots=True)
class Turn:
    """What the two paths differ by over the motor's turn on runs that the fit had not seen: fusion.pyx.

    One number per wave, TURN_WAVES of them: the part that does not change, and those that go with the loss [Nm/Nm], the
    speed and its square. covariance_nm2: lower triangle, row by row, of what days and motions leave of the waves; limit:
    largest square of what is left, against that covariance.
    """

    constant_nm: Annotated[tuple[float, ...], limits("Nm")]
    loss_share: Annotated[tuple[float, ...], limits()]
    viscous_nms_per_rad: Annotated[tuple[float, ...], limits("Nms/rad")]
    quadratic_nms2_per_rad2: Annotated[tuple[float, ...], limits("Nms2/rad2")]
    covariance_nm2: Annotated[tuple[float, ...], limits("Nm2")]
    limit: Annotated[float, limits(gt=0.0)]

    def __post_init__(self) -> None:
        check(self, "fused.agreement.turn")
        sizes = dict.fromkeys(
            ("constant_nm", "loss_share", "viscous_nms_per_rad", "quadratic_nms2_per_rad2"), TURN_WAVES
        )
        for key, count in {**sizes, "covariance_nm2": TURN_WAVES * (TURN_WAVES + 1) // 2}.items():
            found = getattr(self, key)
            if len(found) != count:
                raise FieldError(
                    "fused.agreement.turn", key, numbers_text(len(found)), f"a list of {count} finite numbers"
                )
        try:
            self.root()
        except (ValueError, ZeroDivisionError):
            raise FieldError(
                "fused.agreement.turn",
                "covariance_nm2",
                list(self.covariance_nm2),
                "the lower triangle of a covariance: positive definite",
            ) from None

    def root(self) -> list[list[float]]:
        """Return the rows of the lower triangle R [Nm] with R R' = covariance, by Cholesky without numpy: the supervisor
        does not load it. Raises ValueError or ZeroDivisionError where the covariance is not positive definite.
        """
        rows: list[list[float]] = []
        left = iter(self.covariance_nm2)
        for k in range(TURN_WAVES):
            row: list[float] = []
            for n in range(k):
                known = sum(a * b for a, b in zip(row, rows[n], strict=False))
                row.append((next(left) - known) / rows[n][n])
            row.append(math.sqrt(next(left) - sum(a * a for a in row)))
            rows.append(row)
        if not all(row[-1] > 0.0 for row in rows):
            raise ValueError("found a covariance that is singular, expected a positive definite one")
        return rows


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far the two paths differ on runs that the fit had not seen, zeros of the day apart; beyond it sigma grows.

    slow_nm, fast_nm: RMS levels of the difference's trend and of the rest; gain: of one path against the other; zero_nm: a
    link zero that is not taken off, as torque; lowered_nm: doubt that ordinary days have, which lowers no status; 0: not
    known; level_factor, gain_factor, zero_factor: how much larger an error is than its trace in the difference; gain_sigmas:
    of its own standard deviations, what of a gain is no doubt, in `gain` neither; turn: waves over the motor's turn, None:
    not known. All: fusion.pyx.
    """

    slow_nm: Annotated[float, limits("Nm", gt=0.0)]
    fast_nm: Annotated[float, limits("Nm", gt=0.0)]
    gain: Annotated[float, limits(ge=0.0)]
    zero_nm: Annotated[float, limits("Nm", ge=0.0)]
    lowered_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    level_factor: Annotated[float, limits(ge=1.0, le=10.0)] = 1.4
    gain_factor: Annotated[float, limits(ge=1.0, le=10.0)] = 2.0
    zero_factor: Annotated[float, limits(ge=1.0, le=10.0)] = 1.0
    gain_sigmas: Annotated[float, limits(ge=0.0, le=10.0)] = 0.0
    turn: Turn | None = None

    def __post_init__(self) -> None:
        check(self, "fused.agreement")


@dataclass(frozen=True, slots=True)
class DayZeros:
    """How far the zero of the link encoder differs from day to day, where `track_zeros` can learn it: fusion.pyx.

    spread_rad: standard deviation over the days of the fit; spread_nm: its part of sigma.torsion_nm, which what is learned
    takes away again; scale: in place of sigma.scale where zeros are tracked; correlation_s: so long the
    difference of the two paths keeps what is no state of the day, None: `fusion.CORRELATION_S`; early: of files
    before, counts for nothing.
    """

    spread_rad: Annotated[float, limits("rad", gt=0.0)]
    spread_nm: Annotated[float, limits("Nm", gt=0.0)]
    scale: Annotated[tuple[float, float, float, float], limits()]
    correlation_s: Annotated[float, limits("s", gt=0.0, le=10.0)] | None = None
    early: Annotated[float, limits(ge=1.0, le=10.0)] | None = None

    def __post_init__(self) -> None:
        check(self, "fused.zeros")
        if not min(self.scale) > 0.0:
            raise FieldError("fused.zeros", "scale", list(self.scale), "4 numbers > 0")


@dataclass(frozen=True, slots=True)
class Tracking:
    """How the torsion is tracked where the configuration has `track_torsion`, and what that adds to sigma, as squares.

    rate_rad_s, wave_rad_s: of the tracking filter: larger is noisier and follows quicker (observer.tracked); sigma_nm,
    viscous_nms_per_rad |v|: of what is quicker than the motor path, found on runs that the fit had not seen; that part
    grows no more far above saturation_rad_s, None: without end. Without wave_rad_s the section is of a filter that there
    no longer is, and counts for nothing.
    """

    rate_rad_s: Annotated[float, limits("rad/s", ge=10.0, le=5000.0)]
    sigma_nm: Annotated[float, limits("Nm", ge=0.0)]
    viscous_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)]
    wave_rad_s: Annotated[float, limits("rad/s", ge=0.0, le=5000.0)] | None = None
    saturation_rad_s: Annotated[float, limits("rad/s", gt=0.0, le=1e6)] | None = None

    def __post_init__(self) -> None:
        check(self, "fused.tracking")

    @property
    def bend(self) -> float:
        """By what the part in speed is bent, s^2/rad^2: divided by 1 + bend v^2."""
        return 0.0 if self.saturation_rad_s is None else 1.0 / self.saturation_rad_s**2


@dataclass(frozen=True, slots=True)
class Standstill:
    """Half width of the interval of a standing joint in standard deviations, besides what friction and slip leave open.

    Found on runs that the fit had not seen (`jtq fit losses`). Definition: fusion.pyx.
    """

    sigmas: Annotated[float, limits(gt=0.0, le=100.0)]

    def __post_init__(self) -> None:
        check(self, "fused.standstill")


MAX_CELLS: Final = 127
"""Cells of the map in each direction."""

_LEAST: Final = 1e-6
_MOST: Final = 1e6
"""Limits of steps and distance, far beyond any joint: their reciprocals stay numbers."""


def _map(rows: Any) -> tuple[tuple[int, ...], ...]:
    """Return the map of rows of 0 and 1: texts such as "0110" in joint files, lists in networks. Raises ValueError."""
    if not (isinstance(rows, list) and all(isinstance(row, str | list) for row in rows)):
        raise ValueError("found no rows")
    if len({len(row) for row in rows}) != 1 or not len(rows) % 2 == len(rows[0]) % 2 == 1:
        raise ValueError("found no middle cell")
    if not all(type(cell) in (int, str) and str(cell) in ("0", "1") for row in rows for cell in row):
        raise ValueError("found other cells")
    if max(len(rows), len(rows[0])) > MAX_CELLS:
        found = Verbatim(f"{len(rows)} rows of {len(rows[0])} cells")
        raise FieldError("envelope", "", found, f"at most {MAX_CELLS} of either")
    return tuple(tuple(map(int, row)) for row in rows)


def _range(value: Any) -> tuple[float, float]:
    """Return the lowest and highest of a range. Raises ValueError."""
    if not isinstance(value, list):
        raise ValueError("found no list")
    low, high = (float(each) for each in value if type(each) in (int, float))
    if not -math.inf < low <= high < math.inf:
        raise ValueError("found no range")
    return low, high


_Torque = Annotated[float, limits("Nm", ge=_LEAST, le=_MOST)]


@dataclass(frozen=True, slots=True)
class Envelope:
    """What the training data of a fused network, or the runs of a fit, covered.

    velocity_step_rad_s, torque_step_nm: distance of cell centres; known: [2 nv + 1][2 nt + 1] of 0 and 1 over velocity
    and motor torque, its middle cell at zero; distance_nm: largest |torsion - current path|; temperature_c: lowest
    and highest, None where the joint reports none; load_nm: largest |joint torque|, None where that is not known (networks).
    """

    velocity_step_rad_s: Annotated[float, limits("rad/s", ge=_LEAST, le=_MOST)]
    torque_step_nm: _Torque
    known: Annotated[
        tuple[tuple[int, ...], ...],
        parsed(_map, 'odd numbers of rows and of cells in each, rows as texts such as "0110"'),
    ]
    distance_nm: _Torque
    temperature_c: Annotated[tuple[float, float], parsed(_range, "[lowest, highest] in degC, or none")] | None
    load_nm: _Torque | None = None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for the metadata of a network, which has no load."""
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name != "load_nm"}


@dataclass(frozen=True, slots=True)
class Fused:
    """Section `fused` of a joint file; torsion None: a joint whose link encoder does not measure torque.

    agreement: of the two paths on runs that the fit had not seen. envelope: what the runs of the fit covered; outside of it
    the status is degraded. tracking: of the torsion. zeros: of the days. standstill: of the interval at rest. None: nothing
    is known of that.
    """

    loss: AdditiveLoss
    torsion: Torsion | None
    sigma: FusedSigma
    agreement: Agreement | None = None
    envelope: Envelope | None = None
    tracking: Tracking | None = None
    zeros: DayZeros | None = None
    standstill: Standstill | None = None

    def __post_init__(self) -> None:
        if self.zeros is not None and not self.zeros.spread_nm < self.sigma.torsion_nm:
            expected = f"less than sigma.torsion_nm ({self.sigma.torsion_nm:g} Nm), of which it is a part"
            raise FieldError("fused", "zeros.spread_nm", self.zeros.spread_nm, expected)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain dicts and lists, as `Joint.to_mapping`."""
        result: dict[str, Any] = _plain(self)
        return result


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Where and how fast the joint may be moved, joint side: what planned experiments keep. The estimator does not read it.

    travel_rad: lowest and highest position; what is left out is not limited.
    """

    travel_rad: Annotated[tuple[float, float], limits("rad")] = (-1e6, 1e6)
    velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)] = 1e6
    acceleration_rad_s2: Annotated[float, limits("rad/s2", gt=0.0)] = 1e6
    torque_nm: Annotated[float, limits("Nm", gt=0.0)] = 1e6

    def __post_init__(self) -> None:
        check(self, "motion_limits")
        if not self.travel_rad[0] < self.travel_rad[1]:
            raise FieldError(
                "motion_limits", "travel_rad", list(self.travel_rad), "two rising numbers in rad"
            )


@dataclass(frozen=True, slots=True)
class Effect:
    """One term of the extended model: a name of the effect library and its parameters in SI units.

    Defaults are filled in. Raises ConfigError for an unknown name, an unknown, missing or implausible parameter.
    """

    name: Annotated[str, choice(EFFECTS)]
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with below("parameters"):
            parameters = checked_parameters(self.name, self.parameters)
        object.__setattr__(self, "parameters", MappingProxyType(parameters))

    def __reduce__(self) -> tuple[type[Effect], tuple[str, dict[str, float]]]:
        """Copy and pickle through plain dicts: a mapping proxy can do neither."""
        return Effect, (self.name, dict(self.parameters))


ELASTIC: Final = ("stiffness_nm_per_rad", "damping_nms_per_rad", "link_inertia_kgm2")
"""Keys that only the torsion between two encoders, and a plant, need."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """One joint: `joint.yaml` as values. Numbers out of range raise ConfigError (replace() too).

    `effects` add to what the other sections say; an effect that replaces one of their values may be there once. Stiffness
    and damping of a joint with one encoder may be NaN: not known. `peak_torque_nm`: no torque beyond it is sent.
    """

    name: Text
    gear_ratio: Annotated[float, limits(gt=0.0)]
    torque_constant_nm_per_a: Annotated[float, limits("Nm/A", gt=0.0)]
    rotor_inertia_kgm2: Annotated[float, limits("kg m2", gt=0.0)]
    stiffness_nm_per_rad: Annotated[float, limits("Nm/rad", gt=0.0)] = math.nan
    damping_nms_per_rad: Annotated[float, limits("Nms/rad", ge=0.0)] = math.nan
    link_inertia_kgm2: Annotated[float, limits("kg m2", ge=0.0)] = 0.0
    rated_torque_nm: Annotated[float, limits("Nm", gt=0.0)]
    peak_torque_nm: Annotated[float, limits("Nm", gt=0.0)] | None = None
    friction: Friction
    efficiency: Efficiency | None = None
    fused: Fused | None = None
    effects: tuple[Effect, ...] = ()
    motion_limits: MotionLimits | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self, f"joint {self.name}")
        object.__setattr__(self, "effects", tuple(self.effects))
        self._check_effects()
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))

    def __reduce__(self) -> tuple[partial[Joint], tuple[()]]:
        """Copy and pickle through plain dicts: a mapping proxy can do neither."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return partial(Joint, **{**values, "provenance": dict(self.provenance)}), ()

    def _check_effects(self) -> None:
        """Refuse two right values for one key."""
        seen: set[str] = set()
        for effect in self.effects:
            if any(p.key for p in EFFECTS[effect.name].parameters):
                if effect.name in seen:
                    found = Verbatim(f"{effect.name!r} twice")
                    raise FieldError(f"joint {self.name}", "effects", found, "it once")
                seen.add(effect.name)

    @classmethod
    def from_mapping(cls, mapping: object, where: str, *, elastic: bool = True) -> Joint:
        """Build from what a YAML parser gave; `where` names the file in messages. Raises ConfigError.

        elastic: the keys ELASTIC must be there; otherwise they may.
        """
        return decode(cls, mapping, where, required=ELASTIC if elastic else ())

    def to_mapping(self) -> dict[str, Any]:
        """Return plain dicts and lists in file order; `from_mapping` of it gives an equal joint."""
        result: dict[str, Any] = _plain(self)
        return result


def _unknown(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _plain(value: Any) -> Any:
    """Return the plain form of a section; what is None or NaN, and what a torsion may leave out, is not written."""
    if is_dataclass(value):
        items = {each.name: getattr(value, each.name) for each in fields(value)}
        if isinstance(value, Envelope):
            items["known"] = tuple("".join(map(str, row)) for row in value.known)
        if isinstance(value, Torsion):
            items = {name: None if item == () else item for name, item in items.items()}
            if value.zero_limit_rad == ZERO_LIMIT_RAD:
                del items["zero_limit_rad"]
        known = {name: item for name, item in items.items() if item is not None and not _unknown(item)}
        return {name: _plain(item) for name, item in known.items()}
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return dict(value) if isinstance(value, Mapping) else value
