"""The unexplained residual: maps, events and lines in residuals of which it is known what is in them; and in noise
nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis import structure
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.structure import (
    QUICK_ORDERS,
    SIGNIFICANT,
    Balance,
    View,
    axis_edges,
    axis_values,
    bins_of,
    chance,
    conditions,
    events,
    frequency_lines,
    order_lines,
    pursue,
    seconds,
    sharpened,
)
from jtqd.sysid.diagnosis.unexplained import Unexplained, _bins, _places
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, run_data

STEP_S = 0.005
BLOCK = 200
SECONDS = 30


def motion(seed: int, seconds: int = SECONDS) -> dict[str, FloatArray]:
    """Conditions of a run: back and forth under a load of another period."""
    rng = np.random.default_rng(seed)
    t = STEP_S * np.arange(seconds * BLOCK)
    rate, phase = rng.uniform(0.8, 1.2), rng.uniform(0.0, 6.0)
    link = 0.8 * np.sin(rate * t + phase)
    return {
        "velocity": 0.8 * rate * np.cos(rate * t + phase),
        "load": 20.0 * np.sin(1.9 * t + 2.0 * phase),
        "link_angle": link,
        "motor_angle": 100.0 * link,
        "current": 0.1 * np.sin(2.3 * t + phase),
    }


def noise(seed: int, seconds: int = SECONDS) -> FloatArray:
    """Coloured within a second, another size in each, no sign of its own: all that the test by signs asks for."""
    rng = np.random.default_rng([seed, 9])
    white = rng.normal(size=(seconds, BLOCK))
    mixed = np.cumsum(white, axis=1) * 0.03 + 0.3 * white
    sizes = rng.uniform(0.1, 1.0, (seconds, 1)) * rng.choice([-1.0, 1.0], (seconds, 1))
    return np.asarray(0.1 * (mixed * sizes).ravel())


def runs_with(
    torque: Callable[[dict[str, FloatArray]], FloatArray],
    channel: Channel = TORSION1,
    many: int = 4,
    seed: int = 0,
) -> tuple[Balance, list[FloatArray]]:
    axes = [motion(seed + k) for k in range(many)]
    parts = [torque(a) + noise(seed + k) for k, a in enumerate(axes)]
    runs = [run_data(f"run{k}", {channel: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))]
    return balance(runs, channel), parts


def balance(runs: list[RunData], channel: Channel = MOTOR1, rated_nm: float = 50.0) -> Balance:
    return Balance(runs, channel, STEP_S, rated_nm)


def view_of(found: tuple[Balance, list[FloatArray]], axis: str) -> View:
    """The view of this axis, in the direction in which it explains most."""
    return max((v for v in conditions(*found) if v.axis == axis), key=lambda v: v.energy_nm2)


def nothing(a: dict[str, FloatArray]) -> FloatArray:
    return 0.0 * a["velocity"]


def test_p_is_uniform_where_there_is_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coloured noise of changing size: no model of it is made, and p still means what it says (in one direction)."""
    monkeypatch.setattr(structure, "FLIPS", 999)  # enough for the middle of the distribution
    p = []
    for seed in range(50):
        some, parts = runs_with(nothing, seed=1000 + 10 * seed, many=2)
        plain = [v for v in conditions(some, parts) if v.axis in ("link_angle", "load")][::2]
        p += [chance(v, parts, STEP_S) for v in plain]
    values = np.sort(p)
    distance = np.max(np.abs(values - (np.arange(len(values)) + 0.5) / len(values)))
    assert len(values) == 100
    assert distance < 1.63 / np.sqrt(50), (
        "Kolmogorov and Smirnov, 1 %; the axes of one set are not independent"
    )
    assert np.mean(values < 0.05) < 0.12


def test_structure_is_found_with_its_energy_and_its_place() -> None:
    def bump(a: dict[str, FloatArray]) -> FloatArray:
        return np.asarray(0.4 * np.exp(-(((a["link_angle"] - 0.3) / 0.1) ** 2)))

    some, parts = runs_with(bump)
    found = view_of((some, parts), "link_angle")
    assert chance(found, parts, STEP_S) < SIGNIFICANT
    place = found.bins[0]
    assert found.edges is not None
    assert found.edges[place] - 0.05 < 0.3 < found.edges[place + 1] + 0.05
    energy = float(np.mean(np.concatenate([bump(motion(k)) for k in range(4)]) ** 2))
    assert found.energy_nm2 == pytest.approx(energy, rel=0.15)


@pytest.mark.parametrize("channel", [MOTOR1, TORSION1])
def test_a_loss_that_follows_the_direction_is_seen(channel: Channel) -> None:
    """Its mean over both directions is zero; a cover that rubs on the link is in both balances."""

    def loss(a: dict[str, FloatArray]) -> FloatArray:
        return np.asarray(0.4 * np.sign(a["velocity"]) * np.exp(-(((a["link_angle"] - 0.3) / 0.1) ** 2)))

    some, parts = runs_with(loss, channel)
    found = view_of((some, parts), "link_angle")
    assert chance(found, parts, STEP_S) < SIGNIFICANT
    assert found.energy_nm2 > 0.005


def test_a_map_is_of_what_is_valid() -> None:
    some, parts = runs_with(lambda a: 0.02 * a["load"])
    for x in parts:
        x[300:900] = np.nan
    bins = bins_of(some, "load", parts)
    assert bins is not None
    load = np.concatenate([a["load"] for a in some.axes])
    x = np.concatenate(parts)
    everything = float(np.nansum(x**2))
    for place in _bins("load", *bins, parts, 0.0):
        here = (load >= place.low) & (load < place.high) & np.isfinite(x)
        assert place.rms_nm**2 == pytest.approx(float(np.mean(x[here] ** 2)))
        assert place.share == pytest.approx(float(np.sum(x[here] ** 2)) / everything)


def test_a_few_seconds_prove_nothing() -> None:
    axes = motion(1, 6)
    x = np.sign(axes["load"])
    some = balance([run_data("run", {TORSION1: x}, axes)], TORSION1)
    assert {chance(v, [x], STEP_S) for v in conditions(some, [x])} == {1.0}


def test_axes_that_do_not_vary_have_no_map() -> None:
    assert axis_edges("velocity", np.zeros(1000)) is None
    assert axis_edges("temperature", np.linspace(30.0, 31.5, 1000)) is None
    assert axis_edges("temperature", np.full(1000, np.nan)) is None
    edges = axis_edges("temperature", np.linspace(30.0, 36.0, 1000))
    assert edges is not None
    assert (edges[0], edges[-1]) == pytest.approx((30.0, 36.0))
    axes = {
        "velocity": np.array([1.0, 1.0, -1.0, -1.0]),
        "load": np.array([1.0, -1.0, 1.0, -1.0]),
        "motor_angle": np.array([7.0, -1.0, 0.0, 3.0]),
        "link_angle": np.array([7.0, -1.0, 0.0, 4.0]),
    }
    assert axis_values(axes, "quadrant").tolist() == [0.0, 1.0, 2.0, 3.0]
    assert axis_values(axes, "motor_angle") == pytest.approx([7.0 - 2 * np.pi, 2 * np.pi - 1.0, 0.0, 3.0])
    assert axis_values(axes, "link_angle") == pytest.approx([7.0 - 2 * np.pi, -1.0, 0.0, 4.0 - 2 * np.pi])


AR = np.array([0.7, -0.2])


def gaussian(seed: int, count: int = 12000) -> FloatArray:
    """0.1 Nm rms or so, autoregressive."""
    e = np.random.default_rng(seed).normal(0.0, 0.1, count)
    out = np.zeros(count)
    for t in range(2, count):
        out[t] = e[t] + AR[0] * out[t - 1] + AR[1] * out[t - 2]
    return out


def at_least(nm: float, runs: list[RunData], of_rated: float = 0.005) -> Balance:
    """The balance of a joint whose events count from this size on: 0.5 % of its rated torque."""
    return balance(runs, rated_nm=nm / of_rated)


def test_events_are_found_at_their_times() -> None:
    parts = [gaussian(k) for k in range(3)]
    parts[0][4000:4010] += 3.0  # a reading that drops for 50 ms
    parts[2][8000:8200] -= 2.0  # a second that is off: a step at both ends
    parts[2][11000:11050] = np.nan
    runs = [run_data(f"run{k}", {MOTOR1: x}, {}) for k, x in enumerate(parts)]
    found = events(at_least(0.5, runs), parts)
    assert found is not None
    assert [t for name, t in found.times if name == "run0"] == [20.0]
    assert [t for name, t in found.times if name == "run2"] == [40.0], "one event is one event"
    assert {name for name, _ in found.times} == {"run0", "run2"}
    dip, second = 10 * 9.0 / 36000.0, 200 * 4.0 / 36000.0
    assert found.energy_nm2 == pytest.approx(dip + second, rel=0.05), (
        "all of the second, not its two steps alone"
    )
    assert found.masks[0][4000:4010].all()
    assert found.masks[2][8000:8200].all()
    assert not found.masks[1].any()
    assert sum(m.sum() for m in found.masks) / 36000.0 < 0.01
    assert events(at_least(9.0, runs), parts) is None, "too small to be relevant"


def test_an_event_is_all_of_it() -> None:
    """A sensor that is off for a third of a second: between its two steps whitening shows nothing."""
    x = gaussian(4)
    x[6000:6066] += 5.0
    found = events(at_least(0.5, [run_data("run0", {MOTOR1: x}, {})]), [x])
    assert found is not None
    assert found.masks[0][6000:6066].all()
    assert found.masks[0].sum() < 66 + 60
    assert found.energy_nm2 == pytest.approx(66 * 25.0 / 12000.0, rel=0.1)


def test_gaussian_noise_has_no_events() -> None:
    for seed in range(5):
        parts = [gaussian(10 * seed + k, 24000) for k in range(2)]
        runs = [run_data(f"run{k}", {MOTOR1: x}, {}) for k, x in enumerate(parts)]
        assert events(at_least(0.0, runs), parts) is None


def turning(seed: int) -> dict[str, FloatArray]:
    """A motor that turns on at a speed that changes: 8 to 30 rad/s, 1 to 5 Hz."""
    rng = np.random.default_rng(seed)
    t = STEP_S * np.arange(24 * BLOCK)
    speed = 45.0 + 12.0 * np.sin(rng.uniform(0.1, 0.3) * t + rng.uniform(0.0, 6.0))
    return {"velocity": speed / 100.0, "motor_angle": np.cumsum(speed) * STEP_S}


@pytest.mark.parametrize(("order", "amplitude"), [(3.5, 0.3), (1.74, 0.15)])
def test_lines_that_turn_with_the_motor_have_their_order_and_size(order: float, amplitude: float) -> None:
    axes = [turning(k) for k in range(2)]
    parts = [
        amplitude * np.cos(order * a["motor_angle"] + k) + 0.3 * noise(k, 24) for k, a in enumerate(axes)
    ]
    parts[0][500:560] = np.nan
    runs = [run_data(f"run{k}", {MOTOR1: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))]
    line = order_lines(runs, {MOTOR1: parts}, STEP_S)[0]
    assert line.order == pytest.approx(order, abs=0.021), "half the distance of orders that are looked at"
    assert line.amplitude_nm == pytest.approx(amplitude, rel=0.15)
    assert (line.channel, line.unit) == (MOTOR1, "1/rev")
    assert sharpened(line, runs, parts, STEP_S).order == pytest.approx(order, abs=0.001)
    hertz = [h for h in frequency_lines(runs, {MOTOR1: parts}, STEP_S) if h.ratio > line.ratio]
    assert hertz == [], "no line at one frequency"


def test_a_line_between_two_orders_keeps_its_size_when_the_motor_turns_fast() -> None:
    """Seventy turns in two seconds: a fiftieth of an order off is more than a turn, and the line all but gone."""
    t = STEP_S * np.arange(24 * BLOCK)
    axes = [
        {"velocity": np.full(len(t), 2.2), "motor_angle": 220.0 * t + 3.0 * np.sin(0.4 * t + k)}
        for k in range(2)
    ]
    order = 2.475
    parts = [0.5 * np.cos(order * a["motor_angle"]) + 0.3 * noise(k, 24) for k, a in enumerate(axes)]
    runs = [run_data(f"run{k}", {MOTOR1: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))]
    line = min(order_lines(runs, {MOTOR1: parts}, STEP_S), key=lambda found: abs(found.order - order))
    sharp = sharpened(line, runs, parts, STEP_S)
    assert line.amplitude_nm < 0.4
    assert sharp.amplitude_nm == pytest.approx(0.5, rel=0.05)
    assert sharp.order == pytest.approx(order, abs=0.0005)


@pytest.mark.parametrize(("hz", "amplitude"), [(6.3, 0.2), (12.0, 0.1)])
def test_lines_of_one_frequency_have_it_and_their_size(hz: float, amplitude: float) -> None:
    axes = [turning(k) for k in range(2)]
    t = STEP_S * np.arange(24 * BLOCK)
    parts = [amplitude * np.cos(2 * np.pi * hz * t + k) + 0.3 * noise(k, 24) for k in range(2)]
    parts[1][700:760] = np.nan
    runs = [run_data(f"run{k}", {MOTOR1: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))]
    line = frequency_lines(runs, {MOTOR1: parts}, STEP_S)[0]
    assert line.order == pytest.approx(hz, abs=0.13), "half a bin of 4 s"
    assert line.amplitude_nm == pytest.approx(amplitude, rel=0.16), "up to 15 % between two bins"
    assert line.unit == "Hz"


def test_noise_has_no_strong_lines() -> None:
    for seed in range(4):
        axes = [turning(10 * seed + k) for k in range(2)]
        parts = [gaussian(10 * seed + k, 24 * BLOCK) for k in range(2)]
        runs = [run_data(f"run{k}", {MOTOR1: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))]
        lines = order_lines(runs, {MOTOR1: parts}, STEP_S) + frequency_lines(runs, {MOTOR1: parts}, STEP_S)
        assert all(line.ratio < 25.0 for line in lines)


def test_a_motor_that_hardly_turns_has_no_orders() -> None:
    still = {"motor_angle": np.linspace(0.0, 20.0, 24 * BLOCK)}
    x = np.cos(3.5 * still["motor_angle"])
    assert order_lines([run_data("run", {MOTOR1: x}, still)], {MOTOR1: [x]}, STEP_S) == []


@pytest.mark.parametrize(("order", "hz"), [(24.0, 0.0), (0.0, 35.3)])
def test_a_quick_wave_is_found_with_its_order_or_frequency(order: float, hz: float) -> None:
    """Of 0.4 Nm in noise of 1 Nm, at up to 200 Hz; noise alone has none."""
    step_s, t = 1e-3, 1e-3 * np.arange(12000)
    angles = [np.cumsum(45.0 + 12.0 * np.sin(0.3 * t + k)) * step_s for k in range(3)]
    random = np.random.default_rng(5)
    for amplitude in (0.4, 0.0):
        parts = [
            amplitude * np.cos(order * a + 2.0 * np.pi * hz * t) + random.normal(size=len(t)) for a in angles
        ]
        parts[0][500:900] = np.nan
        runs = [RunData(f"run{k}", t, {}, {1: {"time": t, "motor_angle": a}}) for k, a in enumerate(angles)]
        found = structure.lines(Balance(runs, MOTOR1, step_s, 50.0), parts, QUICK_ORDERS)
        assert len(found) == (1 if amplitude else 0)
        for view in found:
            assert view.line is not None
            assert view.line.order == pytest.approx(order or hz, abs=0.13)
            assert view.energy_nm2 == pytest.approx(0.5 * amplitude**2, rel=0.3)


def test_an_angle_in_few_digits_is_no_structure_where_its_steps_are_known() -> None:
    """Steps of 0.1 rad of the motor beyond 1000 rad, of 0.01 rad below: 3 and 0.3 Nm in torsion."""
    t, per_rad = STEP_S * np.arange(24 * BLOCK), 30.0
    runs, parts, steps = [], [], []
    for k in range(3):
        angle = 700.0 + 40.0 * t + 25.0 * np.sin(1.3 * t + k)
        step = np.where(angle < 1000.0, 0.01, 0.1)
        parts.append(per_rad * (step * np.round(angle / step) - angle) + 0.02 * noise(k, 24))
        steps.append(per_rad * step)
        runs.append(RunData(f"run{k}", t, {}, {1: {"time": t, "motor_angle": angle}}))
    for known in (True, False):
        for run, step in zip(runs, steps, strict=True):
            run.axes[1]["torsion"] = step if known else np.zeros(len(t))
        of = Balance(runs, TORSION1, STEP_S, 50.0)
        found = [*structure.lines(of, parts), events(of, parts), seconds(of, parts)]
        assert [v for v in found if v] == [] if known else any(found)


def test_a_zero_that_jumps_wanders() -> None:
    rng = np.random.default_rng(0)
    steady = rng.normal(0.0, 0.5, 6000)
    level = np.repeat(rng.choice([-0.3, 0.3], 30), 200)
    runs = [run_data("run", {MOTOR1: steady}, {})]

    def wandering(nm: float, x: FloatArray) -> View | None:
        return seconds(at_least(nm, runs), [x])

    assert wandering(0.1, steady) is None
    seldom = steady + np.repeat(np.where(np.arange(30) % 10 == 4, 1.0, 0.0), 200)
    far = wandering(0.7, seldom)
    assert far is not None
    assert sorted(t for _, t in far.times[:3]) == pytest.approx([4.5, 14.5, 24.5]), (
        "seldom, but far out of all others"
    )
    assert wandering(0.05, steady) is None, "ordinary seconds are not far out"
    found = wandering(0.1, steady + level)
    assert found is not None
    assert found.energy_nm2 == pytest.approx(0.09, rel=0.15)
    (place,) = _places(found, [steady + level], 0.0, float(np.mean((steady + level) ** 2)))
    assert place.share == pytest.approx(0.09 / 0.34, rel=0.2)
    assert place.bin.startswith("seconds: run ")


def test_what_remains_counts_once_per_channel() -> None:
    """A torque that follows the load goes along with the current, and its steps may be events: it counts once."""

    def torque(a: dict[str, FloatArray]) -> FloatArray:
        return np.asarray(1.5 * np.sign(a["load"]))

    axes = [motion(k) | {"current": 0.01 * motion(k)["load"]} for k in range(4)]
    parts = [torque(a) + noise(k) for k, a in enumerate(axes)]
    runs = [run_data(f"run{k}", {MOTOR1: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))]
    one = balance(runs)
    left = Unexplained({MOTOR1: pursue(one, parts)}, {MOTOR1: one})
    assert left.by_channel() == {MOTOR1: pytest.approx(1.5**2, rel=0.1)}
    assert left.worst_nm == {MOTOR1: pytest.approx(1.5, rel=0.1)}
    assert left.by_channel().keys() == {MOTOR1}
    assert len(left.reasons) == len(left.views[MOTOR1])
    assert all(reason.startswith("joint 1, motor balance: ") for reason in left.reasons)
