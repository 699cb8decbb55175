"""Builds the C contender: parameters.h from the fixture, then gcc -O2."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.core import joint as joint_cycle
from jtqd.daemon.core.status import NEEDED
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import BLEND_CURRENT_A, LossModel
from jtqd.estimator.native_network import FADE_START
from jtqd.estimator.observer import LINK_SPEED_LIMIT_RAD_S, RAW_LIMIT
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED
from tests.benchmarks.fixture import (
    ENVELOPE_HIGH,
    ENVELOPE_LOW,
    SIGMA_NM,
    Fixture,
    SmallNetwork,
    small_network,
)
from tests.benchmarks.traffic import SCALING, SENSOR_NM_PER_UNIT
from tests.daemon import ring_records as rr

_SOURCE = Path(__file__).resolve().parent
_COMPILE = ("gcc", "-std=gnu11", "-O2", "-Wall", "-Wextra")


def build(fixture: Fixture) -> Path:
    """Compile loop.c for this fixture; returns the program. Raises CalledProcessError, or FileNotFoundError without gcc."""
    (fixture.directory / "parameters.h").write_text(_header(load_config(fixture.config)), encoding="utf-8")
    program = fixture.directory / "loop"
    command = [*_COMPILE, f"-I{fixture.directory}", str(_SOURCE / "loop.c"), "-o", str(program), "-lm"]
    subprocess.run(command, check=True)
    return program


def _header(config: Config) -> str:
    names = {
        "RECORD_SIZE": rr.RECORD_SIZE,
        "FRAME_CAPACITY": rr.FRAME_CAPACITY,
        "RING_SLOTS": config.ring_cycles,
        "STAMP_ACCURACY_NS": joint_cycle.STAMP_ACCURACY_NS,
        "DEGRADED_CYCLES": NEEDED[DEGRADED],
        "MAX_GAP_S": config.estimator.max_gap_s,
        "WAIT_NS": config.input_wait_ns,
        "DEADLINE_NS": config.input_deadline_ns,
        "FOLLOW_STEP_NS": 160,  # these three as in daemon/core/schedule.pyx
        "FOLLOW_MARGIN_NS": 10_000,
        "FOLLOW_SHORTEST_NS": 50_000,
        "MOTOR_RAD_PER_COUNT": SCALING["motor_rad_per_count"],
        "MOTOR_RAD_S_PER_UNIT": SCALING["motor_rad_s_per_unit"],
        "LINK_RAD_PER_COUNT": SCALING["link_rad_per_count"],
        "AMPERE_PER_UNIT": SCALING["ampere_per_unit"],
        "NM_PER_UNIT": SENSOR_NM_PER_UNIT,
    }
    lines = [f"#define {name} {value!r}" for name, value in names.items()]
    joints = [_joint(each.joint, config.estimator, small_network(each.number)) for each in config.joints]
    return "\n".join([*lines, f"static const joint_parameters parameters[2] = {{{', '.join(joints)}}};", ""])


def _joint(joint: Joint, settings: EstimatorSettings, network: SmallNetwork) -> str:
    friction, losses = joint.friction, LossModel(joint)
    assert joint.efficiency is not None
    margin = settings.envelope_margin
    limit = settings.network_limit * joint.rated_torque_nm
    values: dict[str, object] = {
        "gear": joint.gear_ratio,
        "inverse_gear": 1.0 / joint.gear_ratio,
        "kt": joint.torque_constant_nm_per_a,
        "inertia_rate": joint.rotor_inertia_kgm2 * settings.bandwidth_rad_s,
        "rate": settings.bandwidth_rad_s,
        "link_rate": settings.link_bandwidth_rad_s,
        "coulomb": friction.coulomb_nm,
        "stribeck": friction.stribeck_nm,
        "viscous": friction.viscous_nms_per_rad,
        "inverse_stribeck": 1.0 / friction.stribeck_velocity_rad_s,
        "inverse_w0": 50.0,
        "static_friction": friction.coulomb_nm + friction.stribeck_nm,
        "quadrants": losses.quadrants,
        "torque_per_ampere": losses.torque_per_ampere,
        "inverse_gain": 1.0 / losses.torque_per_ampere,
        "inverse_blend": 1.0 / BLEND_CURRENT_A,
        "no_blend": 6.1 * BLEND_CURRENT_A,
        "floor": settings.sigma_floor * joint.rated_torque_nm,
        "u_friction": settings.friction_uncertainty,
        "limit": settings.torque_limit * joint.rated_torque_nm,
        "raw_limit": RAW_LIMIT * joint.rated_torque_nm,
        "link_speed_limit": LINK_SPEED_LIMIT_RAD_S,
        "stop": settings.standstill_velocity_rad_s,
        "leave": 2.0 * settings.standstill_velocity_rad_s,
        "max_gap": settings.max_gap_s,
        "low": ENVELOPE_LOW,
        "high": ENVELOPE_HIGH,
        "inverse_margin": 1.0 / (margin * (ENVELOPE_HIGH - ENVELOPE_LOW)),
        "distance_limit": limit,
        "fade": FADE_START * limit,
        "inverse_fade": 1.0 / (limit - FADE_START * limit),
        "network_sigma": SIGMA_NM,
        "network": _weights(network),
    }
    return "{" + ", ".join(f".{name} = {_literal(value)}" for name, value in values.items()) + "}"


def _weights(network: SmallNetwork) -> str:
    *hidden, (w4, b4) = network.layers
    values: dict[str, object] = {"w4": w4[:, 0], "b4": float(b4[0])}
    for n, (w, b) in enumerate(hidden, 1):
        values |= {f"w{n}": w, f"b{n}": b}
    scales = ("input_mean", "input_std", "output_mean", "output_std")
    values |= {name: getattr(network, name) for name in scales}
    return "{" + ", ".join(f".{name} = {_literal(value)}" for name, value in values.items()) + "}"


def _literal(value: object) -> str:
    """A number, nested sequence or array as a C initialiser; a text is one already."""
    if isinstance(value, str):
        return value
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Iterable):
        return "{" + ", ".join(_literal(each) for each in value) + "}"
    return repr(value)
