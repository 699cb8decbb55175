"""What the bench's own channels make of the truth: delays, offsets, noise, quantisation. Columns [n] of one run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from validation.hidden.integrator import Truth
from validation.hidden.nominal import Drift
from validation.hidden.plant import Array, Plant
from validation.hidden.profiles import STEP_S, Motion
from validation.hidden.strange import Fault

MOTOR_COUNTS: Final = 65536
LINK_COUNTS: Final = 524288
SENSOR_WHITE_NM: Final = 0.02
SENSOR_SLOW_NM: Final = 0.05
CURRENT_WHITE_A: Final = 0.010
CURRENT_SLOW_A: Final = 0.003
_VELOCITY_FILTER_S: Final = 1e-3


def measured(  # noqa: PLR0917
    truth: Truth,
    p: Plant,
    b: int,
    motion: Motion,
    drift: Drift,
    rng: np.random.Generator,
    quiet: bool = False,
    faults: Sequence[Fault] = (),
) -> dict[str, Array]:
    """Return the run table of bench b as columns; quiet: no noise, no quantisation, no zeros."""
    n = len(motion.on)
    t = STEP_S * np.arange(n)
    noise = 0.0 if quiet else 1.0
    columns = {"time_s": t}
    sensor = _sensor(truth, p, b, motion, t) + noise * (drift.sensor_nm + _sensor_noise(rng, n))
    for fault in faults:
        span = slice(fault.start, fault.start + fault.count)
        sensor[span] = 0.0 if fault.dropped else sensor[span] + fault.value_nm
    for j in range(2):
        name = f"j{j + 1}"
        current = _late(truth.current_a[:, j, b], p.current_delay[j, b]) + p.current_offset[j, b]
        current += noise * (rng.normal(0.0, CURRENT_WHITE_A, n) + _slow(rng, n, 5.0, CURRENT_SLOW_A))
        motor = truth.motor_rad[:, j, b]
        motor = motor + p.motor_eccentricity[j, b] * np.sin(motor + p.motor_eccentricity_phase[j, b])
        link = (1 - 2 * j) * truth.link_rad[:, b]
        link = _late(link, p.link_delay[j, b])
        link = link + p.link_eccentricity[j, b] * np.sin(link + p.link_eccentricity_phase[j, b])
        link += noise * drift.link_rad[j]
        if not quiet:
            motor = _quantised(motor, MOTOR_COUNTS)
            link = _quantised(link, LINK_COUNTS)
        temperature = motion.temperature_c[j]
        columns[f"{name}.current_a"] = current
        columns[f"{name}.motor_position_rad"] = motor
        columns[f"{name}.motor_velocity_rad_s"] = _velocity(motor)
        columns[f"{name}.link_position_rad"] = link
        columns[f"{name}.link_velocity_rad_s"] = _velocity(link)
        columns[f"{name}.torque_nm"] = sensor
        columns[f"{name}.temperature_c"] = temperature if quiet else np.round(temperature, 1)
        if motion.marked is not None:
            columns[f"{name}.enabled"] = np.where(motion.marked, 0.0, 1.0)
    return columns


def _sensor(truth: Truth, p: Plant, b: int, motion: Motion, t: Array) -> Array:
    """Return the sensor's reading without its own noise; its temperature is that of joint 1."""
    torque = _late(truth.sensor_nm[:, b], p.sensor_delay[0, b])
    turn = np.cos(truth.link_rad[:, b] + p.crosstalk_phase[0, b])
    reading = p.sensor_gain[0, b] * torque + p.sensor_offset[0, b] + p.sensor_rate[0, b] * t
    reading += p.sensor_per_k[0, b] * (motion.temperature_c[0] - p.sensor_reference[0, b])
    reading += (p.crosstalk[0, b] + p.crosstalk_share[0, b] * torque) * turn
    total: Array = reading
    return total


def _late(x: Array, delay_s: float) -> Array:
    """Return x as it was delay_s ago: cubic between samples, the first value before them."""
    if delay_s == 0.0:
        return x
    back = delay_s / STEP_S
    whole = int(np.floor(back))
    f = back - whole
    padded = np.concatenate((np.full(whole + 2, x[0]), x, x[-1:]))
    n = len(x)
    # newest to oldest of the four neighbours of t - delay: 1 sample newer, at, 1 older, 2 older
    a, b, c, d = (padded[2 - k + 1 : 2 - k + 1 + n] for k in range(4))
    return (
        -f * (1 - f) * (2 - f) / 6 * a
        + (1 + f) * (1 - f) * (2 - f) / 2 * b
        + (1 + f) * f * (2 - f) / 2 * c
        - (1 + f) * f * (1 - f) / 6 * d
    )


def _sensor_noise(rng: np.random.Generator, n: int) -> Array:
    corner_hz = float(rng.uniform(1.0, 2.0))
    noise: Array = rng.normal(0.0, SENSOR_WHITE_NM, n) + _slow(rng, n, corner_hz, SENSOR_SLOW_NM)
    return noise


def _slow(rng: np.random.Generator, n: int, corner_hz: float, rms: float) -> Array:
    """Return first-order coloured noise of this standard deviation."""
    f = np.fft.rfftfreq(n, STEP_S)
    shape = 1.0 / np.sqrt(1.0 + (f / corner_hz) ** 2)
    shape[0] = 0.0  # a zero of its own is the drift's business
    spectrum = shape * (rng.normal(size=len(f)) + 1j * rng.normal(size=len(f)))
    x: Array = np.fft.irfft(spectrum, n)
    expected = np.sqrt(2.0 * np.sum(2.0 * shape**2)) / n
    x *= rms / expected
    return x


def _quantised(x: Array, counts: int) -> Array:
    step = 2 * np.pi / counts
    rounded: Array = step * np.round(x / step)
    return rounded


def _velocity(position: Array) -> Array:
    """Return backward differences through a low pass of 1 ms, at standstill before the first sample."""
    rate = np.diff(position, prepend=position[0]) / STEP_S
    a = np.exp(-STEP_S / _VELOCITY_FILTER_S)
    # impulse response a^k (1 - a) is below 1e-9 after 24 samples
    kernel = (1 - a) * a ** np.arange(24)
    smooth: Array = np.convolve(rate, kernel)[: len(rate)]
    return smooth
