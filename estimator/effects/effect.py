"""An effect: one physical deviation of a joint from the rigid textbook joint, for plant, estimator and diagnosis alike.

With true values in capitals of what is measured (i, tau_s, theta_l) and K the stiffness, a joint with effects obeys, joint
side,

    tau_gear = G (Kt I - Jm alpha) - loss0 - loss_nm                 motor balance
    tau_gear = K (theta_m/G - THETA_L + twist_rad) + D (...)          torsion balance
    tau_gear = TAU_S + Jl alpha_l + load_nm                           link balance
    i = I + current_a      theta_l = THETA_L + link_rad      tau_s = TAU_S + sensor_nm

so that the residuals of a simulation without the effect are, from what is measured,

    G (Kt i - Jm alpha) - loss0 - tau_s - Jl alpha_l    =  G Kt current_a + loss_nm + load_nm - sensor_nm
    K (theta_m/G - theta_l) + D (...) - tau_s - Jl alpha_l  =  -K (twist_rad + link_rad) + load_nm - sensor_nm

A hook is elementwise: fields of the state are floats or arrays alike, and functions come from `x` (`Functions`), so
that one formula serves the 1 kHz loop and whole runs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, replace
from operator import attrgetter
from typing import Any, ClassVar, Final, NamedTuple, Protocol, TypeVar

Values = Mapping[str, float]
"""Parameters of an effect by name, SI units."""

MOTOR: Final = "motor"
TORSION: Final = "torsion"
BALANCES: Final = (MOTOR, TORSION)
HOOKS: Final = ("loss_nm", "twist_rad", "load_nm", "current_a", "link_rad", "sensor_nm")
GROUPS: Final = ("friction", "transmission", "actuator", "measurement", "load")


class FrictionValues(Protocol):
    """Friction of a joint file as effects read it (`estimator.joint.Friction`)."""

    @property
    def coulomb_nm(self) -> float: ...
    @property
    def viscous_nms_per_rad(self) -> float: ...
    @property
    def stribeck_nm(self) -> float: ...
    @property
    def stribeck_velocity_rad_s(self) -> float: ...


class Joint(Protocol):
    """Values of a joint file that effects read (`estimator.joint.Joint` has them all)."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def gear_ratio(self) -> float: ...
    @property
    def torque_constant_nm_per_a(self) -> float: ...
    @property
    def rotor_inertia_kgm2(self) -> float: ...
    @property
    def stiffness_nm_per_rad(self) -> float: ...
    @property
    def damping_nms_per_rad(self) -> float: ...
    @property
    def link_inertia_kgm2(self) -> float: ...
    @property
    def rated_torque_nm(self) -> float: ...
    @property
    def friction(self) -> FrictionValues: ...
    @property
    def provenance(self) -> Mapping[str, Any]: ...


AnyJoint = TypeVar("AnyJoint", bound=Joint)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter: plausible range low..high in `unit`; default None: must be given, NaN: the joint file's own value.

    fixed: not refined by fits (an order, a channel); whole: a whole number, a code. key: dotted key of the joint file
    whose value it replaces, "" for none. neutral: value without the effect, of a parameter without a key; None where it is
    where or how the effect acts (a phase, an order) and not how large it is. prior: name of the prior of its size, or of the
    effect's where this code is set; "" for that of the effect.
    """

    name: str
    unit: str
    low: float
    high: float
    default: float | None = None
    fixed: bool = False
    key: str = ""
    whole: bool = False
    neutral: float | None = 0.0
    prior: str = ""


class Column(NamedTuple):
    """A column of the search for an effect: parameter, its step, parameters that are fixed in it.

    of: key of the joint file that the step is a part of; "" for a step in the parameter's own unit.
    """

    name: str
    step: float
    fixed: Mapping[str, float] = {}
    of: str = ""


def order(low: float = 0.1, default: float | None = 2.0) -> Parameter:
    """Return the order of a wave over the motor's angle."""
    return Parameter("order_per_motor_rev", "1/rev", low, 1000.0, default=default, fixed=True, neutral=None)


def waves(name: str, step: float, orders: Sequence[float]) -> tuple[Column, ...]:
    """Return a column of each order of a wave over the motor's angle."""
    return tuple(Column(name, step, {"order_per_motor_rev": each}) for each in orders)


PHASE: Final = Parameter("phase_rad", "rad", -2.0 * math.pi, 2.0 * math.pi, default=0.0, neutral=None)
REFERENCE: Final = Parameter("reference_c", "°C", -100.0, 200.0, neutral=None)
SHAFT_ORDERS: Final = (1.0, 2.0, 4.0)
"""Per motor revolution: shaft, the wave generator's two lobes, and their second harmonic."""


@dataclass(slots=True, eq=False)
class State:
    """What a hook may use, floats or arrays [n] of one joint in its own frame; NaN where it is not known.

    current_a as measured; velocity_rad_s = omega_m/G; direction: sign of velocity, between -1 and 1 near rest;
    motor_*: motor side; link_*: joint side; coupling_position_rad: link position of joint 1 (= - that of joint 2), the
    sensor's angle; torque_nm: what the gear transmits; torsion_rad: theta_m/G - theta_l less its zero, with its
    rate; time_s since the run's first sample.
    """

    current_a: Any = math.nan
    current_rate_a_s: Any = math.nan
    coupling_position_rad: Any = math.nan
    direction: Any = math.nan
    link_acceleration_rad_s2: Any = math.nan
    link_position_rad: Any = math.nan
    link_velocity_rad_s: Any = math.nan
    motor_acceleration_rad_s2: Any = math.nan
    motor_position_rad: Any = math.nan
    temperature_c: Any = math.nan
    time_s: Any = math.nan
    torque_nm: Any = math.nan
    torque_rate_nm_s: Any = math.nan
    torsion_rad: Any = math.nan
    torsion_rate_rad_s: Any = math.nan
    velocity_rad_s: Any = math.nan


class Functions(Protocol):
    """Elementwise functions for floats (`ScalarFunctions`) or arrays (`ArrayFunctions`); clip: a held within low..high.

    slip: Maxwell-slip state in -1..1, dz = dd/travel held within; it remembers, so every effect of every joint has
    `Functions` of its own in the loop, and an array is taken in order from z = 0.
    """

    def sin(self, a: Any) -> Any: ...
    def cos(self, a: Any) -> Any: ...
    def exp(self, a: Any) -> Any: ...
    def tanh(self, a: Any) -> Any: ...
    def clip(self, a: Any, low: float, high: float) -> Any: ...
    def slip(self, d: Any, travel: float) -> Any: ...


class ScalarFunctions:
    """Functions of floats, sample by sample; one instance per effect and joint: `slip` has a state, 0 at the first d.

    The Maxwell slip is the friction of one elastic contact (Al-Bender, Lampaert, Swevers 2005, IEEE Trans. Automatic
    Control 50): z follows the deflection d, dz = dd/travel, and slips at -1 and 1.
    """

    __slots__ = ("_last", "_z")

    def __init__(self) -> None:
        self._z = 0.0
        self._last = math.nan

    sin: Final = staticmethod(math.sin)
    cos: Final = staticmethod(math.cos)
    tanh: Final = staticmethod(math.tanh)

    @staticmethod
    def exp(a: float) -> float:
        """Return e^a, infinite where a float cannot hold it (as numpy)."""
        return math.exp(a) if a < 709.0 else math.inf

    @staticmethod
    def clip(a: float, low: float, high: float) -> float:
        """Return a held within low..high; NaN stays."""
        return low if a < low else high if a > high else a

    def slip(self, d: float, travel: float) -> float:
        """Return the state, -1 to 1, after the deflection went on to d; NaN: it stays where it was."""
        if d != d:  # noqa: PLR0124 - NaN, without a call
            return self._z
        step = (d - self._last) / travel
        self._last = d
        if step == step:  # noqa: PLR0124
            z = self._z + step
            self._z = 1.0 if z > 1.0 else -1.0 if z < -1.0 else z
        return self._z


class ArrayFunctions:
    """Functions of arrays [n] in order of time. It remembers nothing: every array starts with z = 0."""

    __slots__ = ("clip", "cos", "sin", "tanh")

    def __init__(self) -> None:
        import numpy as np  # the supervisor checks joint files with this library and has none

        self.sin, self.cos, self.tanh, self.clip = np.sin, np.cos, np.tanh, np.clip

    def exp(self, a: Any) -> Any:
        """Return e^a, infinite without a warning where a float cannot hold it."""
        import numpy as np

        with np.errstate(over="ignore"):
            return np.exp(a)

    def slip(self, d: Any, travel: float) -> Any:
        """Return the states [n] of deflections d [n]; NaN: the state stays where it was."""
        import numpy as np

        last, z = math.nan, 0.0
        out: list[float] = []
        add = out.append
        # a plain loop: 0.1 us per sample, and the very numbers of `ScalarFunctions`
        for now in np.asarray(d, np.float64).tolist():
            step = (now - last) / travel
            if step == step:  # noqa: PLR0124
                z += step
                if z > 1.0:
                    z = 1.0
                elif z < -1.0:
                    z = -1.0
                last = now
            elif now == now:  # noqa: PLR0124
                last = now
            add(z)
        return np.array(out)


FALLBACK_C: Final = 25.0
"""Reference temperature of a joint file that names none."""

SPAN_K: Final = 10.0
"""Distance of the reference temperatures of the two columns of a temperature term."""

_FLAT: Final = 1e-9
"""Slopes below this part of the constant say nothing about the reference temperature."""


@dataclass(frozen=True, slots=True)
class Term:
    """A way to look for an effect by linear regression: the hooks at each of `basis` (less the hooks at the joint
    file's own values) are columns; `combine(coefficients)` of the columns gives the parameters.
    """

    basis: tuple[Mapping[str, float], ...]
    combine: Any  # Callable[[Sequence[float]], dict[str, float]]


def full(value: float, like: Any) -> Any:
    """Return the value for a float, an array [n] of it for an array [n]."""
    if isinstance(like, float):  # of the loop, in every cycle
        return value
    import numpy as np

    return np.full(like.shape, value) if isinstance(like, np.ndarray) else value


def above(temperature_c: Any, reference_c: float) -> Any:
    """Return temperature less reference, 0 where the temperature is not known (not finite)."""
    difference = temperature_c - reference_c
    if isinstance(difference, float | int):
        return difference if math.isfinite(difference) else 0.0
    import numpy as np

    return np.where(np.isfinite(difference), difference, 0.0)


def reference_of(provenance: Mapping[str, Any]) -> float:
    """Return the temperature [°C] of the joint file's values, from its provenance."""
    value = provenance.get("temperature_c")
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else FALLBACK_C  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Linear:
    """parameter k = base_k + c_k step_k; the rest is fixed."""

    names: tuple[str, ...]
    base: tuple[float, ...]
    step: tuple[float, ...]
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the parameters of coefficients c."""
        rows = zip(self.names, self.base, self.step, c, strict=True)
        return {name: base + float(k) * step for name, base, step, k in rows} | dict(self.fixed)

    def term(self) -> Term:
        """Return the term: one column per parameter, the others at their base."""
        count = range(len(self.names))
        return Term(tuple(self([float(row == column) for column in count]) for row in count), self)


Terms = Sequence[Term]
"""Ways to look for one effect."""


def linear(name: str, step: float, base: float = 0.0, **fixed: float) -> Term:
    """Return the term of one parameter in which the hooks are linear; base: the joint file's value."""
    return Linear((name,), (base,), (step,), fixed).term()


@dataclass(frozen=True, slots=True)
class Wave:
    """c1 cos(a) - c2 sin(a), or c1 sin(a) + c2 cos(a), as amplitude >= 0 and phase in (-pi, pi].

    Both are c1 f(a) + c2 f(a + pi/2) = A f(a + phi) with A (cos phi, sin phi) = (c1, c2), f the cosine or the sine.
    """

    amplitude: str
    step: float
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the parameters of coefficients c."""
        along, across = float(c[0]), float(c[1])
        phase = math.atan2(across, along)
        values = {
            self.amplitude: math.hypot(along, across) * self.step,
            "phase_rad": math.pi if phase == -math.pi else phase,
        }
        return values | dict(self.fixed)

    def term(self) -> Term:
        """Return the term: columns at phase 0 and at a quarter turn."""
        basis = tuple(
            {self.amplitude: self.step, "phase_rad": phase} | dict(self.fixed)
            for phase in (0.0, 0.5 * math.pi)
        )
        return Term(basis, self)


@dataclass(frozen=True, slots=True)
class Slope:
    """k (T - T0) with k = (c1 + c2) step and T0 from the constant part; T0 = reference_c where there is no slope."""

    name: str
    step: float
    reference_c: float
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the parameters of coefficients c."""
        first, second = float(c[0]), float(c[1])
        slope = first + second
        reference = self.reference_c
        if abs(slope) > _FLAT * abs(second):
            reference += second * SPAN_K / slope
        return {self.name: slope * self.step, "reference_c": reference} | dict(self.fixed)

    def term(self) -> Term:
        """Return the term: columns at the reference and SPAN_K above; both together give slope and constant."""
        return Term(
            tuple(
                {self.name: self.step, "reference_c": self.reference_c + span} | dict(self.fixed)
                for span in (0.0, SPAN_K)
            ),
            self,
        )


REGISTERED: Final[dict[str, Effect]] = {}
"""One instance of every subclass of `Effect`, by name."""


class Effect:
    """Base of all effects. A file of this package holds one subclass, which has the file's name.

    equation, source: one line each; tell_tale: where it shows and how one recognises it.
    experiment: kind of motion that shows it (`sysid.planner.experiments.EXPERIMENTS`).
    confused_with: effect that looks the same on poor runs -> kind of motion that separates the two; a pair stands in one of
    both files. by_hand: such an effect -> what separates the two besides a motion.
    hooks: those that it overrides; needs: fields of State without which it cannot be judged.
    columns: of the search, each the sine or cosine of a wave where a parameter is `PHASE`; none: it overrides `terms`.
    dissipative: loss_nm is a friction (opposes velocity). at_sensor: it belongs to the coupling's sensor, not to a joint.
    geometric: its twist is one of the teeth, so the damper beside the spring feels its rate too (kinematic error), unlike
    a property of the spring itself. follows_torsion: its state follows the torsion itself (slip, play), for which tau/K is
    not good enough. rate_based: it is known by a derivative of measured angles or torques.
    whole_orders: of a wave, orders per motor revolution that are looked for beside those of its columns.
    scales_all: it scales everything that the sensor reads. scales_balance: it scales the whole of this balance of a joint.
    changes_joint: `joint()` is all of it for plant and estimator, which then leave its hooks alone (inertias, damping).
    """

    name: ClassVar[str]
    group: ClassVar[str]  # of GROUPS
    equation: ClassVar[str]
    source: ClassVar[str]
    tell_tale: ClassVar[str]
    experiment: ClassVar[str] = "excitation"
    confused_with: ClassVar[Mapping[str, str]] = {}
    by_hand: ClassVar[Mapping[str, str]] = {}
    parameters: ClassVar[tuple[Parameter, ...]]
    hooks: ClassVar[tuple[str, ...]]
    needs: ClassVar[tuple[str, ...]] = ()
    columns: ClassVar[tuple[Column, ...]] = ()
    dissipative: ClassVar[bool] = False
    at_sensor: ClassVar[bool] = False
    changes_joint: ClassVar[bool] = False
    geometric: ClassVar[bool] = False
    follows_torsion: ClassVar[bool] = False
    rate_based: ClassVar[bool] = False
    whole_orders: ClassVar[range] = range(0)
    scales_all: ClassVar[bool] = False
    scales_balance: ClassVar[str] = ""

    def __init_subclass__(cls) -> None:
        """Register an instance. Raises TypeError without a hook, or for an unknown group."""
        cls.name = cls.__module__.rpartition(".")[2]
        cls.hooks = tuple(hook for hook in HOOKS if getattr(cls, hook) is not getattr(Effect, hook))
        if not cls.hooks:
            raise TypeError(f"effect {cls.name}: found no hook, expected one of {HOOKS}")
        if cls.group not in GROUPS:
            raise TypeError(f"effect {cls.name}: found group {cls.group!r}, expected one of {GROUPS}")
        REGISTERED[cls.name] = cls()

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """Motor torque lost in addition to the joint file's losses, Nm joint side."""
        raise NotImplementedError

    def twist_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """What the spring sees in addition to theta_m/G - theta_l, rad."""
        raise NotImplementedError

    def load_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """Torque taken between gear and sensor in addition to the file's link inertia, Nm."""
        raise NotImplementedError

    def current_a(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """What the current reads above the truth, A."""
        raise NotImplementedError

    def link_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """What the link encoder reads above the truth, rad."""
        raise NotImplementedError

    def sensor_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """What the torque sensor reads above the truth, Nm."""
        raise NotImplementedError

    def joint(self, p: Values, joint: AnyJoint) -> AnyJoint:
        """Return the joint with the values that the effect replaces (`changes_joint`)."""
        if not self.changes_joint:
            return joint
        return replace(joint, **{each.key: p[each.name] for each in self.parameters})

    def at_sensor_of(self, p: Values) -> bool:
        """Return whether it belongs to the coupling's sensor with these parameters (see `at_sensor`)."""
        return self.at_sensor

    def age_s(self, p: Values) -> float:
        """Return how old a reading is with these parameters, s: rates that the hooks use are means over so long."""
        return 0.0

    def at_motor_of(self, p: Values) -> bool:
        """Whether with these parameters it is the motor's encoder that reads wrong: by -G link_rad, motor side."""
        return False

    def terms(self, joint: Joint) -> Terms:
        """Ways to look for it, one per column; the best is taken and its parameters refined."""
        return [self._term(column, joint) for column in self.columns]

    def _term(self, column: Column, joint: Joint) -> Term:
        """Return the term of a column: a wave, or linear from the joint file's value on."""
        name, step, fixed, of = column
        if PHASE in self.parameters:
            return Wave(name, step, fixed).term()
        key = next(each.key for each in self.parameters if each.name == name)
        own = attrgetter(key)(joint) if key else 0.0
        return linear(name, step * attrgetter(of)(joint) if of else step, own, **fixed)

    def term_of_order(self, order: float) -> Term | None:
        """Way to look for a wave of `order` per motor revolution; None for other effects."""
        if not self.is_wave:
            return None
        column = self.columns[0]
        return Wave(column.name, column.step, {"order_per_motor_rev": float(order)}).term()

    @property
    def is_wave(self) -> bool:
        """Whether it is a wave over the motor's angle, of which several orders may be present at once."""
        return any(each.name == "order_per_motor_rev" for each in self.parameters)
