"""Open questions of other projects, rebuilt in MuJoCo from their public descriptions and answered by `jtq diagnose`.

    python -m validation open_questions --seed 1 --sets 20 [--question another_unit]

| question | thread | what is rebuilt |
|---|---|---|
| load_friction | google-deepmind/mujoco 3528 | loss of a gear grows with its torque, driving and back-driving |
| compliant_gear, .._one_encoder | leggedrobotics/pace-sim2real 19 | a link rings at 5 to 15 Hz, a rigid model cannot |
| another_unit | Rhoban/bam 17 | values of one servo are used for another one: which differ? |
| inertials | google-deepmind/mujoco 3284 | inertias that joint data of one axis cannot separate |
| no_load | isaac-sim/IsaacLab 3410 | friction identified without a load: what of friction under load? |

One set is a joint: four to six runs of 15 to 25 s as CSV, a column map, a joint file with wrong values. The answer is read
from findings.json alone. A cause is certain by its `grade`; where there is none, if its class is its own name. A certain
cause is wrong if these runs cannot decide it, or if its interval excludes the true value and its value is no nearer to
that than the joint file's.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from jtqd.estimator.command_line import count, natural
from jtqd.sysid.diagnosis import command
from validation.diagnosis.entries import Array, Columns
from validation.diagnosis.mujoco_bench import SHAPES
from validation.study import Report, Table, in_processes

STEP_S: Final = 1e-3
DT_S: Final = STEP_S / 4  # a target that moves once per STEP_S puts steps into the current
GRAVITY: Final = 9.80665
Motion = Callable[[np.random.Generator, Array], Array]
"""Times [n] at 1 kHz -> angles [n]."""


# The rig: a drive, a gear with spring and damper, a link, and what is mounted on it.


@dataclass(frozen=True)
class Rig:
    """True values, SI, joint side but for `torque_constant` and `rotor_inertia` (motor side).

    mass_kg at lever_m hangs at link angle 0; load_inertia, about the axis, is all of the mounted load's.
    """

    rated: float
    ratio: float
    torque_constant: float
    rotor_inertia: float
    stiffness: float
    damping: float
    link_inertia: float
    coulomb: float
    viscous: float
    load_coefficient: float
    load_inertia: float
    mass_kg: float
    lever_m: float

    @property
    def reflected(self) -> float:
        return self.rotor_inertia * self.ratio**2

    @property
    def rated_a(self) -> float:
        return self.rated / (self.ratio * self.torque_constant)


def model_xml(rig: Rig) -> str:
    own, mass = rig.load_inertia - rig.mass_kg * rig.lever_m**2, rig.mass_kg or 1e-3
    return f"""<mujoco>
  <option timestep="{DT_S}" gravity="0 0 {-GRAVITY}" integrator="Euler" solver="Newton"><flag eulerdamp="disable"/></option>
  <worldbody>
    <body name="rotor"><inertial pos="0 0 0" mass="1" diaginertia="1e-9 1e-9 1e-9"/>
      <joint name="motor" axis="0 1 0" armature="{rig.reflected!r}" frictionloss="{rig.coulomb!r}" damping="{rig.viscous!r}"
        solreffriction="{2 * DT_S} 1" solimpfriction="0.99 0.999 0.001"/></body>
    <body name="link"><inertial pos="0 0 {-rig.lever_m!r}" mass="{mass!r}" diaginertia="{own!r} {own!r} {own!r}"/>
      <joint name="link" axis="0 1 0" armature="{rig.link_inertia!r}"/></body>
  </worldbody>
  <tendon><fixed name="gear" stiffness="{rig.stiffness!r}" damping="{rig.damping!r}" springlength="0 0">
    <joint joint="motor" coef="1"/><joint joint="link" coef="-1"/></fixed></tendon>
  <actuator><general joint="motor" gear="{rig.ratio!r}" gainprm="{rig.torque_constant!r}" biastype="none"/></actuator>
</mujoco>"""


def integrate(rig: Rig, target_rad: Array) -> Columns:
    """Return what happens while a position controller at the motor follows target_rad [n] with up to 1.5 x rated current, at
    1 kHz: `time_s`, `current_a`, `motor_rad` and `link_rad` (both joint side), `load_nm` (link on load), [n] each.

    MuJoCo's `frictionloss` is a constant; before every step it is set to coulomb + mu |torque that the gear transmits|.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(model_xml(rig))
    data = mujoco.MjData(model)
    data.qpos[:] = target_rad[0]
    inertia, omega = rig.reflected + rig.link_inertia + rig.load_inertia, 2.0 * math.pi * 4.0
    kd = 1.4 * inertia * omega / (rig.ratio * rig.torque_constant)
    kp, limit = kd * omega / 1.4, 1.5 * rig.rated_a
    fine = np.arange(0.0, len(target_rad), DT_S / STEP_S)
    wanted = np.interp(fine, np.arange(len(target_rad)), target_rad)
    rates = np.gradient(wanted, DT_S).tolist()
    out = np.empty((len(fine), 4))
    qpos, qvel, qacc, ctrl, loss = data.qpos, data.qvel, data.qacc, data.ctrl, model.dof_frictionloss
    for k, (angle, rate) in enumerate(zip(wanted.tolist(), rates, strict=True)):
        q, link, v = float(qpos[0]), float(qpos[1]), float(qvel[0])
        gear_nm = rig.stiffness * (q - link) + rig.damping * (v - float(qvel[1]))
        current = min(max(kp * (angle - q) + kd * (rate - v), -limit), limit)
        ctrl[0] = current
        loss[0] = rig.coulomb + rig.load_coefficient * abs(gear_nm)
        mujoco.mj_step(model, data)  # qacc is of the moment before it, as the rest
        out[k] = current, q, link, gear_nm - rig.link_inertia * float(qacc[1])
    columns = zip(("current_a", "motor_rad", "link_rad", "load_nm"), out[::4].T, strict=True)
    return {"time_s": STEP_S * np.arange(len(target_rad)), **dict(columns)}


def swings(most_rad: float, slowest_s: float, fastest_s: float) -> Motion:
    """Return a motion of four sines of periods between two, at most `most_rad` in sum, begun softly."""

    def motion(rng: np.random.Generator, t: Array) -> Array:
        periods = np.exp(rng.uniform(np.log(fastest_s), np.log(slowest_s), 4))
        x = sum(p**0.5 * np.sin(2.0 * np.pi * (t / p + rng.uniform())) for p in periods)
        begin = np.clip(t / 1.5, 0.0, 1.0)
        size = most_rad * rng.uniform(0.6, 1.0) / np.max(np.abs(x))
        return np.asarray(size * begin**2 * (3.0 - 2.0 * begin) * x)

    return motion


def chirp(rng: np.random.Generator, t: Array) -> Array:
    """A linear chirp from 0.1 to 8 Hz over a slow swing that turns friction round."""
    phase = 2.0 * np.pi * np.cumsum(0.1 + 7.9 * t / t[-1]) * STEP_S
    window = np.clip(np.minimum(t, t[-1] - t) / 0.5, 0.0, 1.0)
    return np.asarray(rng.uniform(0.01, 0.03) * window * np.sin(phase) + swings(0.4, 8.0, 3.0)(rng, t))


def stairs(rng: np.random.Generator, t: Array) -> Array:
    """Constant velocities up to 0.4 to 0.8 rad/s in both directions."""
    return np.cumsum(rng.uniform(0.4, 0.8) * SHAPES["stairs"](rng, t) * np.clip(t / 0.5, 0.0, 1.0)) * STEP_S


PENDULUM: Final = (swings(1.4, 9.0, 3.0), swings(1.2, 4.0, 1.5))
"""The drive lifts the weight and is driven back by it."""


# One set: true rigs, joint file, motions, instruments.

LOAD: Final = "load_dependent_friction"
VALUES: Final = {
    "torque_constant": ("torque_constant_nm_per_a", "torque_constant"),
    "coulomb_friction": ("coulomb_nm", "coulomb"),
    "viscous_friction": ("viscous_nms_per_rad", "viscous"),
    LOAD: ("load_coefficient", "load_coefficient"),
    "rotor_inertia": ("rotor_inertia_kgm2", "rotor_inertia"),
    "link_inertia": ("link_inertia_kgm2", "link_inertia"),
    "nonlinear_stiffness": ("stiffness_nm_per_rad", "stiffness"),
    "gear_damping": ("damping_nms_per_rad", "damping"),
}
"""Cause -> (its parameter in findings.json, attribute of `Rig`)."""


@dataclass(frozen=True)
class Setup:
    """mean: the true joint; sheet: what the joint file takes it for; rigs: true, one per run, with the friction of its day
    and its weight. sensor: the torque is measured, else the load is known; two_encoders: the link has its own.
    """

    mean: Rig
    sheet: Rig
    rigs: Sequence[Rig]
    motions: Sequence[Array]
    rate_hz: int
    sensor: bool = False
    two_encoders: bool = True

    @property
    def differs(self) -> tuple[str, ...]:
        """Causes that are there: values in which the joint file is not the joint."""
        return tuple(n for n, (_, a) in VALUES.items() if getattr(self.mean, a) != getattr(self.sheet, a))


def _four(x: float) -> float:
    return float(f"{x:.4g}")


def _off(rng: np.random.Generator, low: float, high: float, side: float = 0.0) -> float:
    """Return a factor that is off by low to high, to either side, or to the one given."""
    return 1.0 + (side or float(rng.choice([-1.0, 1.0]))) * float(rng.uniform(low, high))


def _rig(rng: np.random.Generator, mu: tuple[float, float], *, weight: bool = True) -> Rig:
    """Return a stiff geared joint of 5 to 40 Nm; weight: with one that pulls half to two thirds of that, else a flange."""
    rated = _four(float(np.exp(rng.uniform(np.log(5.0), np.log(40.0)))))
    ratio = float(rng.choice([50, 80, 100, 120, 160]))
    lever = _four(rng.uniform(0.2, 0.35)) if weight else 0.0
    mass = _four(rng.uniform(0.5, 0.66) * rated / (GRAVITY * lever)) if weight else 0.0
    return Rig(
        rated=rated,
        ratio=ratio,
        torque_constant=_four(rng.uniform(0.05, 0.15)),
        rotor_inertia=_four(rated * rng.uniform(0.008, 0.02) / ratio**2),
        stiffness=_four(rated * rng.uniform(300.0, 700.0)),
        damping=_four(rated * rng.uniform(0.1, 0.25)),
        link_inertia=_four(rated * rng.uniform(0.001, 0.003)),
        coulomb=_four(rated * rng.uniform(0.03, 0.08)),
        viscous=_four(rated * rng.uniform(0.02, 0.06)),
        load_coefficient=_four(rng.uniform(*mu)),
        load_inertia=_four(1.03 * mass * lever**2 if weight else rated * rng.uniform(0.004, 0.006)),
        mass_kg=mass,
        lever_m=lever,
    )


def _set(rng: np.random.Generator, rig: Rig, motions: Sequence[Motion], **off: float) -> Setup:
    """Return a set; off: attribute -> factor of the file's value. Friction differs by 1 % (viscous 2 %) between runs."""
    sheet = replace(rig, **{a: _four(getattr(rig, a) * factor) for a, factor in off.items()})
    runs = int(rng.integers(4, 7))
    times = [STEP_S * np.arange(int(n)) for n in rng.integers(15_000, 25_001, runs)]
    angles = [motions[k % len(motions)](rng, t) for k, t in enumerate(times)]
    days = 1.0 + np.array([0.01, 0.02]) * rng.uniform(-1.0, 1.0, (runs, 2))
    rigs = [replace(rig, coulomb=rig.coulomb * c, viscous=rig.viscous * v) for c, v in days.tolist()]
    return Setup(rig, sheet, rigs, angles, int(rng.choice([250, 500, 1000])))


def _load_friction(rng: np.random.Generator, number: int) -> Setup:
    """Friction under load is not in the file; by turns a torque sensor with three weights, and one known weight."""
    off = {"load_coefficient": 0.0, "coulomb": _off(rng, 0.15, 0.4), "viscous": _off(rng, 0.2, 0.4)}
    s = _set(rng, _rig(rng, (0.1, 0.25)), PENDULUM, **off)
    if number % 2:
        return replace(s, two_encoders=bool(rng.integers(2)))
    lighter = [(r, (1.0, 0.6, 0.25)[k % 3]) for k, r in enumerate(s.rigs)]
    rigs = [replace(r, mass_kg=p * r.mass_kg, load_inertia=p * r.load_inertia) for r, p in lighter]
    return replace(s, rigs=rigs, sensor=True)


def _compliant(rng: np.random.Generator, number: int) -> Setup:
    """A harmonic drive 20:1 whose link rings at 5 to 15 Hz; the data sheet has other spring, damper and Coulomb friction."""
    rig = _rig(rng, (0.0, 0.0))
    hz, zeta = rng.uniform(5.0, 15.0), rng.uniform(0.04, 0.1)
    stiffness = _four(max(rig.load_inertia * (2.0 * np.pi * hz) ** 2, 110.0))
    damping = _four(2.0 * zeta * math.sqrt(stiffness * rig.load_inertia))
    rotor = _four(rig.reflected / 20.0**2)
    gear = {"stiffness": stiffness, "damping": damping, "ratio": 20.0, "rotor_inertia": rotor}
    off = {"stiffness": float(rng.uniform(1.3, 2.0)), "damping": float(rng.uniform(2.0, 3.5))}
    moved = (chirp, swings(0.6, 5.0, 0.6))
    return _set(rng, replace(rig, link_inertia=0.0, **gear), moved, coulomb=_off(rng, 0.2, 0.4), **off)


def _another_unit(rng: np.random.Generator, number: int) -> Setup:
    """The file is another unit's, friction under load included; two or three values differ. A known weight."""
    spread = {"torque_constant": (0.05, 0.12), "coulomb": (0.1, 0.3)}
    spread |= {"viscous": (0.15, 0.3), "load_coefficient": (0.15, 0.3)}
    chosen = rng.choice(list(spread), int(rng.integers(2, 4)), replace=False)
    return _set(rng, _rig(rng, (0.1, 0.2)), PENDULUM, **{str(a): _off(rng, *spread[a]) for a in chosen})


def _inertials(rng: np.random.Generator, number: int) -> Setup:
    """One encoder, a known weight; inertias of rotor and link wrong to one side. By turns brisk, and slow."""
    rig = _rig(rng, (0.0, 0.0))
    rig = replace(rig, link_inertia=_four(rig.reflected * rng.uniform(0.6, 1.2)))
    side = float(rng.choice([-1.0, 1.0]))
    off = {a: _off(rng, 0.25, 0.45, side) for a in ("rotor_inertia", "link_inertia")}
    moved = swings(0.6, 14.0, 8.0) if number % 2 else swings(0.6, 3.0, 0.6)
    return replace(_set(rng, rig, [moved], coulomb=_off(rng, 0.2, 0.4), **off), two_encoders=False)


def _no_load(rng: np.random.Generator, number: int) -> Setup:
    """A free joint, moved gently: its friction under load is not in the file, and below 0.1 % of the rated torque."""
    off = {"load_coefficient": 0.0, "coulomb": _off(rng, 0.2, 0.5), "viscous": _off(rng, 0.2, 0.5)}
    rig = _rig(rng, (0.08, 0.15), weight=False)
    return replace(_set(rng, rig, (stairs, swings(0.8, 9.0, 5.0)), **off), two_encoders=False)


# What a user has: recordings, column map, joint file.


def recorded(true: Columns, setup: Setup, rng: np.random.Generator) -> Columns:
    """Return the columns of one recording: every n-th row, with noise and the steps of converters and encoders."""
    rated, amps, turn = setup.mean.rated, setup.mean.rated_a, 2.0 * np.pi
    every = round(1.0 / STEP_S / setup.rate_hz)
    x = {name: column[::every] for name, column in true.items()}
    x["motor_rad"] = setup.mean.ratio * x["motor_rad"]
    x["current_a"] = x["current_a"] + 2e-3 * amps * rng.normal(size=len(x["time_s"]))
    x["load_nm"] = x["load_nm"] + 1e-3 * rated * rng.normal(size=len(x["time_s"]))
    steps = {"current_a": 4.0 * amps / 2**14, "motor_rad": turn / 2**14}
    steps |= {"link_rad": turn / 2**20} if setup.two_encoders else {}
    steps |= {"load_nm": 4.0 * rated / 2**16} if setup.sensor else {}
    return {"time_s": x["time_s"], **{n: step * np.round(x[n] / step) for n, step in steps.items()}}


def column_map(setup: Setup) -> dict[str, Any]:
    rig = setup.mean
    mapped = {"time_s": "time_s", "j1.current_a": "current_a", "j1.motor_position_rad": "motor_rad"}
    mapped["j1.link_position_rad"] = "link_rad" if setup.two_encoders else f"motor_rad / {rig.ratio:g}"
    if setup.sensor:
        return {**mapped, "j1.torque_nm": "load_nm"}
    weight = {"mass_kg": rig.mass_kg, "lever_m": rig.lever_m} if rig.mass_kg else {}
    return {**mapped, "j1.load": {**weight, "inertia_kgm2": rig.load_inertia}}


def joint_file(sheet: Rig) -> dict[str, Any]:
    values = {p: getattr(sheet, a) for p, a in VALUES.values()}
    friction = {p: values.pop(p) for p in ("coulomb_nm", "viscous_nms_per_rad")}
    under_load = {"load_coefficient": values.pop("load_coefficient")}
    limits = {"travel_rad": [-1.5, 1.5], "velocity_rad_s": 3.0, "torque_nm": sheet.rated}
    rating = {"name": "rebuilt", "gear_ratio": sheet.ratio, "rated_torque_nm": sheet.rated}
    effects = [{"name": LOAD, "parameters": under_load}] if sheet.load_coefficient else []
    return {**rating, **values, "friction": friction, "motion_limits": limits, "effects": effects}


def write(folder: Path, setup: Setup, rng: np.random.Generator) -> None:
    """Write runs/*.csv, columns.yaml and joint.yaml."""
    (folder / "runs").mkdir()
    for k, (rig, motion) in enumerate(zip(setup.rigs, setup.motions, strict=True), 1):
        columns = recorded(integrate(rig, motion), setup, rng)
        table, head = np.column_stack(list(columns.values())), ",".join(columns)
        np.savetxt(folder / "runs" / f"rec_{k}.csv", table, "%.9g", ",", header=head, comments="")
    for name, mapping in (("columns.yaml", column_map(setup)), ("joint.yaml", joint_file(setup.sheet))):
        (folder / name).write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")


def diagnosed(folder: Path) -> Mapping[str, Any]:
    """Return findings.json of `jtq diagnose` on the files of a folder; without one, {"refused": its last line}."""
    out, errors = folder / "out", io.StringIO()
    words = [str(folder / "runs"), "--columns", str(folder / "columns.yaml")]
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        status = command.main([*words, "--joint", str(folder / "joint.yaml"), "--out", str(out)])
    if status in (0, 3):
        return dict(json.loads((out / "findings.json").read_text(encoding="utf-8")))
    lines = errors.getvalue().replace(str(folder), "").split("\n")
    return {"refused": " ".join(lines[-2:]).strip() or f"exit status {status}"}


# The answer.


class Entry(NamedTuple):
    """A cause as findings.json has it. intervals: parameter -> (value, low, high), infinite where there is no limit."""

    name: str
    certain: bool
    intervals: Mapping[str, tuple[float, float, float]]


class Answer(NamedTuple):
    """listed: names reported as open, or in the next experiment; gain: part of the held-out error that goes away."""

    entries: tuple[Entry, ...]
    listed: frozenset[str]
    gain: float | None
    certain: tuple[str, ...]


def _names(items: Any) -> tuple[str, ...]:
    """Return the names of a list of texts ("link_inertia of joint 1") or of mappings with `name`."""
    texts = [each["name"] if isinstance(each, Mapping) else str(each) for each in items or ()]
    return tuple(text.partition(" of ")[0] for text in texts)


def answer(findings: Mapping[str, Any]) -> Answer:
    entries, listed = [], set(_names(findings.get("cannot_be_told")))
    for cause in findings.get("causes", ()):
        name, names = cause["name"], {*_names(cause.get("class")), *_names(cause.get("rivals"))}
        grade = cause.get("grade") or ("one_of" if names - {name} else "certain")
        intervals = {}
        for parameter, found in cause["parameters"].items():
            low, high = (math.nan if end is None else end for end in found["ci95"] or (None, None))
            intervals[parameter] = (found["value"], low, high)
        entries.append(Entry(name, grade == "certain", intervals))
        if names - {name} and grade != "certain":
            listed |= {name, *names}
    why = (findings.get("next_experiment") or {}).get("why") or ""
    listed |= {n for n in VALUES if n in re.sub(r"[-\s]+", "_", why.lower())}
    gain = findings.get("gain") or {}
    before, after = gain.get("rmse_before_nm"), gain.get("rmse_after_nm")
    certain = tuple(e.name for e in entries if e.certain)
    return Answer(tuple(entries), frozenset(listed), 1.0 - after / before if before else None, certain)


def inside(found: Answer, name: str, setup: Setup) -> bool | None:
    """Return whether the interval of a reported cause holds the true value; None if it is not reported."""
    parameter, attribute = VALUES[name]
    for entry in found.entries:
        if entry.name == name and parameter in entry.intervals:
            _, low, high = entry.intervals[parameter]
            return bool(low <= getattr(setup.mean, attribute) <= high)
    return None


def wrong(found: Answer, setup: Setup, undecidable: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the certain causes that are wrong; see the module."""

    def good(entry: Entry) -> bool:
        parameter, attribute = VALUES.get(entry.name, ("", ""))
        if entry.name in undecidable or parameter not in entry.intervals:
            return False
        true, sheet = getattr(setup.mean, attribute), getattr(setup.sheet, attribute)
        nearer = abs(entry.intervals[parameter][0] - true) < abs(sheet - true)
        return nearer or inside(found, entry.name, setup) is True

    return tuple(e.name for e in found.entries if e.certain and not good(e))


@dataclass(frozen=True)
class Question:
    """A question of another project; reply: what this study answers there, with the fields of `figures`.

    An answer is right if `wanted` (ALL: what differs) is certain with true values inside and held-out runs gain; the largest
    cause is `largest`; `unchanged` is reported with the true value inside or not at all; `undecidable` is not certain, and
    listed by name; and, if `harmless`, nothing certain is wrong.
    """

    thread: str
    draw: Callable[[np.random.Generator, int], Setup]
    reply: str
    wanted: Sequence[str] = ()
    largest: str = ""
    unchanged: Sequence[str] = ()
    undecidable: Sequence[str] = ()
    harmless: bool = False

    def right(self, found: Answer, setup: Setup) -> bool:
        wanted = setup.differs if self.wanted is ALL else self.wanted
        return (
            all(n in found.certain and inside(found, n, setup) for n in wanted)
            and (not wanted or (found.gain or 0.0) > 0.0)
            and (not self.largest or [e.name for e in found.entries[:1]] == [self.largest])
            and all(inside(found, n, setup) is not False for n in self.unchanged)
            and all(n not in found.certain and n in found.listed for n in self.undecidable)
            and not (self.harmless and wrong(found, setup, self.undecidable))
        )


ALL: Final = ("all that differs",)
QUESTIONS: Final = {
    "load_friction": Question(
        "https://github.com/google-deepmind/mujoco/issues/3528",
        _load_friction,
        "In {sets} simulated gears, driving and back-driving, friction under load was the largest cause, with the truth "
        "inside, in {right}. {inside} intervals hold the truth; the held-out error falls by {gain}.",
        wanted=(LOAD,),
        largest=LOAD,
    ),
    "compliant_gear": Question(
        "https://github.com/leggedrobotics/pace-sim2real/issues/19",
        _compliant,
        "With encoders on both sides of a gear that rings at 5 to 15 Hz, spring and damper were found, viscous friction "
        "left as it is, in {right} of {sets} simulated joints. {inside} intervals hold the truth; the held-out error falls "
        "by {gain}.",
        wanted=("nonlinear_stiffness", "gear_damping"),
        unchanged=("viscous_friction",),
    ),
    "compliant_gear_one_encoder": Question(
        "https://github.com/leggedrobotics/pace-sim2real/issues/19",
        lambda rng, number: replace(_compliant(rng, number), two_encoders=False),
        "With the motor's encoder alone, a wrong value was certain in {wrong} of {sets} such joints{names}.",
        harmless=True,
    ),
    "another_unit": Question(
        "https://github.com/Rhoban/bam/issues/17",
        _another_unit,
        "With another unit's parameters, two or three of them 5 to 30 % off, exactly those were found, the truth inside, in "
        "{right} of {sets} simulated servos; something wrong was certain in {wrong}. {inside} intervals hold the truth; the "
        "held-out error falls by {gain}.",
        wanted=ALL,
        harmless=True,
    ),
    "inertials": Question(
        "https://github.com/google-deepmind/mujoco/issues/3284",
        _inertials,
        "With one axis and one encoder the inertias of rotor and link act as their sum: in {right} of {sets} simulated "
        "joints both were listed as open, and neither was certain; something wrong was certain in {wrong}.",
        undecidable=("rotor_inertia", "link_inertia"),
    ),
    "no_load": Question(
        "https://github.com/isaac-sim/IsaacLab/issues/3410",
        _no_load,
        "From runs without a load, friction under load was listed as open, and not certain, in {right} of {sets} simulated "
        "joints that have it; {inside} intervals of Coulomb and viscous friction hold the true value.",
        undecidable=(LOAD,),
    ),
}


@dataclass(frozen=True)
class Outcome:
    """One set. others: reported, not certain; inside: per cause that is there whether its interval holds the truth."""

    question: str
    number: int
    differs: tuple[str, ...]
    verdict: str
    certain: tuple[str, ...]
    others: tuple[str, ...]
    right: bool
    wrong: tuple[str, ...]
    inside: Mapping[str, bool]
    gain: float | None
    cpu_s: float = 0.0


def drawn(name: str, seed: int, number: int) -> tuple[Setup, np.random.Generator]:
    """Return set `number` of a question and the generator of its noise; the same for the same seed."""
    place = list(QUESTIONS).index(name)
    setup = QUESTIONS[name].draw(np.random.default_rng([seed, place, number]), number)
    return setup, np.random.default_rng([seed, place, number, 1])


def scored(name: str, number: int, setup: Setup, findings: Mapping[str, Any]) -> Outcome:
    question, found, refused = QUESTIONS[name], answer(findings), findings.get("refused")
    held = {n: inside(found, n, setup) for n in setup.differs if n not in question.undecidable}
    return Outcome(
        question=name,
        number=number,
        differs=setup.differs,
        verdict=refused or findings["verdict"],
        certain=found.certain,
        others=tuple(e.name for e in found.entries if not e.certain),
        right=not refused and question.right(found, setup),
        wrong=wrong(found, setup, question.undecidable),
        inside={n: good for n, good in held.items() if good is not None},
        gain=found.gain,
    )


def run_task(task: tuple[str, int, int]) -> Outcome:
    """Draw, record, diagnose and score one set: question, seed, number."""
    name, seed, number = task
    setup, rng = drawn(name, seed, number)
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), setup, rng)
        begin = time.process_time()
        outcome = scored(name, number, setup, diagnosed(Path(folder)))
    return replace(outcome, cpu_s=time.process_time() - begin)


def figures(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Return the figures of one question as text, for its row and its reply; gain: median."""
    held = [good for o in outcomes for good in o.inside.values()]
    gains = [o.gain for o in outcomes if o.gain is not None]
    names = sorted({n for o in outcomes for n in o.wrong})
    return {
        "sets": str(len(outcomes)),
        "right": str(sum(o.right for o in outcomes)),
        "wrong": str(sum(bool(o.wrong) for o in outcomes)),
        "inside": f"{sum(held)} of {len(held)}",
        "gain": f"{100.0 * float(np.median(gains)):.0f} %" if gains else "-",
        "cpu": f"{float(np.mean([o.cpu_s for o in outcomes])):.1f} s",
        "names": f" ({', '.join(names)})" if names else "",
    }


def report(outcomes: Sequence[Outcome], seed: int) -> Report:
    rows, notes = [], []
    for name, question in QUESTIONS.items():
        if own := [o for o in outcomes if o.question == name]:
            text = figures(own)
            rows.append((name, *list(text.values())[:-1]))
            notes.append(f"{question.thread}: {question.reply.format(**text)}")
    head = ("question", "sets", "right", "wrong certain", "value inside", "gain", "processor, set")
    notes += [_failure(o) for o in outcomes if not o.right or o.wrong]
    return Report([Table(head, rows)], {"seed": seed}, notes, outcomes)


def _failure(o: Outcome) -> str:
    """Return a line on a set that is not right or has something wrong, for the developers."""
    missed = [n for n, good in o.inside.items() if not good]
    parts = {"there": o.differs, "certain": o.certain, "else": o.others, "wrong": o.wrong, "missed": missed}
    texts = "; ".join(f"{k} {', '.join(names)}" for k, names in parts.items() if names)
    return f"{o.question} set {o.number}: {o.verdict}; {texts}"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=natural, default=1)
    parser.add_argument("--sets", type=count, default=20, help="per question (default 20)")
    parser.add_argument("--question", choices=list(QUESTIONS), help="this one alone")
    parser.add_argument("--processes", type=count, default=1)


def run(options: argparse.Namespace) -> Report:
    """Ask the questions; see the module."""
    names = [options.question] if options.question else list(QUESTIONS)
    tasks = [(name, options.seed, number) for name in names for number in range(options.sets)]
    return report(list(in_processes(run_task, tasks, options.processes, "sets")), options.seed)
