"""The accuracy card: bins against known errors, advice for what is missing, and the files that the command writes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.evaluate.card import Card, load_edges, make_card, speed_edges, temperature_edges
from jtqd.sysid.evaluate.command import main
from jtqd.sysid.evaluate.inputs import Samples
from jtqd.sysid.runs.tables import write_run
from tests.sysid.evaluate.evaluate_helpers import emulated, samples, write_models

JOINT = replace(load_joint(shipped("joint1.yaml")), motion_limits=MotionLimits(velocity_rad_s=3.0))
TIME = np.arange(8000) * 1e-3


def sweep(run: str, zero_nm: float = 0.0, noise_nm: float = 0.1, warm_c: float = 20.0) -> Samples:
    """Every speed to 3 rad/s and every load to 40 Nm in both directions, 30 K of temperature."""
    rng = np.random.default_rng(len(run) + int(100 * abs(zero_nm)))
    sensor = 40.0 * np.sin(2.0 * np.pi * 5.03 * TIME)
    velocity = 3.0 * np.sin(2.0 * np.pi * 0.25 * TIME + 0.3) ** 3
    one = samples(
        {"tob": rng.normal(2.0, 1.0, 8000), "fused": rng.normal(zero_nm, noise_nm, 8000)},
        run=run,
        sensor_nm=sensor,
        velocity_rad_s=velocity,
        raw_nm=sensor,
        sigma_nm=max(noise_nm, 0.1),
    )
    standing = (np.arange(8000) < 200).astype(bool)
    return replace(one, temperature_c=warm_c + 30.0 * TIME / TIME[-1], scored=~standing, standing=standing)


def card_of(runs: list[Samples], joint: Joint = JOINT) -> Card:
    """The card of method `fused`."""
    card = make_card(runs, joint, "fused")
    assert card is not None
    return card


def keys(card: Card) -> list[str]:
    """What is advised."""
    return [each.key for each in card.advice]


def test_nothing_is_advised_where_everything_was_measured_and_the_interval_holds() -> None:
    card = card_of([sweep(f"run{'x' * k}") for k in range(10)])
    assert keys(card) == []
    assert card.error.rmse_nm == pytest.approx(0.1, rel=0.02)
    assert card.baseline is not None
    assert card.baseline.rmse_nm == pytest.approx(np.sqrt(5.0), rel=0.02)
    assert card.interval.share == pytest.approx(0.9, abs=0.01)
    for bins in (card.speed, card.load, card.temperature):
        assert sum(each.error.samples for each in bins if each.error is not None) == pytest.approx(
            card.error.samples, rel=2e-3
        )
        assert all(each.known for each in bins)


def test_an_error_at_one_place_is_in_its_bins_and_is_named() -> None:
    """Ten times the noise where the load drives, above 75 % of rated torque."""
    runs = []
    for k in range(10):
        one = sweep(f"run{'x' * k}")
        far = one.sensor_nm * np.sign(one.velocity_rad_s) < -30.0
        error = np.where(far, 10.0, 1.0) * one.error_nm("fused")
        runs.append(replace(one, estimate_nm=dict(one.estimate_nm) | {"fused": one.sensor_nm + error}))
    card = card_of(runs)
    worst = max(card.load, key=lambda each: each.error.rmse_nm if each.error else 0.0)
    assert (worst.low, worst.high) == (-1.0, -0.75)
    assert worst.error is not None
    assert worst.error.rmse_nm == pytest.approx(1.0, rel=0.03)
    (text,) = [each.text for each in card.advice if each.key == "place"]
    assert "75 to 100 % of rated torque, load drives" in text
    assert [row[0].low for row in card.cells] == [card.speed[0].low] * len(card.load)


def test_what_is_constant_within_a_run_is_called_a_zero() -> None:
    zeros = (0.4, -0.5, 0.3, -0.2, 0.5, -0.4, 0.2, -0.3, 0.45, -0.45)
    card = card_of([sweep(f"run{k}", zero) for k, zero in enumerate(zeros)])
    assert card.zeros == pytest.approx(1.0 - 0.01 / card.error.mse_nm2, abs=0.01)
    assert card.mean_nm == pytest.approx(np.std(zeros, ddof=1), rel=0.03)
    assert keys(card)[:2] == ["interval", "zeros"]
    assert "too small" in card.advice[0].text


def test_the_sensors_zero_is_no_error_of_sigma() -> None:
    """Sigma is that of the torque; the card compares with a sensor that has another zero every day, truth or not."""
    zeros = np.random.default_rng(5).normal(0.0, 0.3, 10)
    runs = [sweep(f"run{'x' * k}", zero) for k, zero in enumerate(zeros)]
    assert card_of(runs).interval.share < 0.5
    known = [replace(each, reference_nm=0.3, true_nm=each.sensor_nm + 5.0) for each in runs]
    assert card_of(known).interval.share == pytest.approx(0.9, abs=0.08)


def test_what_was_not_measured_is_named() -> None:
    """Half of the speed and of the load, motor driving only, at one temperature, three runs that never stand."""
    runs = []
    for k in range(3):
        one = sweep(f"run{'x' * k}")
        keep = (np.abs(one.velocity_rad_s) < 1.5) & (one.sensor_nm * one.velocity_rad_s > 0.0)
        keep &= np.abs(one.sensor_nm) < 20.0
        warm = np.full(8000, 22.0)
        runs.append(replace(one, scored=keep, standing=np.zeros(8000, bool), temperature_c=warm))
    texts = {each.key: each.text for each in card_of(runs).advice}
    assert [key for key in texts if key != "corners"] == ["loads", "speeds", "warmth", "standing", "runs"]
    assert "motor drives the load: 50 to 100 %; load drives the motor: 0 to 100 %" in texts["loads"]
    assert "2 to 3 rad/s" in texts["speeds"]
    assert "between 20 and 25 °C" in texts["warmth"]
    cold = card_of([replace(one, temperature_c=np.full(8000, np.nan)) for one in runs])
    assert cold.temperature == ()
    assert any("no temperature" in each.text for each in cold.advice)
    assert card_of(runs, replace(JOINT, motion_limits=None)).limit_rad_s == 1.5
    whole = [sweep(f"run{'x' * k}") for k in range(10)]
    (advice,) = card_of(whole, replace(JOINT, motion_limits=None)).advice
    assert "No run is faster than 3 rad/s" in advice.text


def test_one_run_is_not_known_and_speed_and_load_may_be_apart() -> None:
    one = card_of([sweep("run")])
    assert not any(each.known for each in one.speed)
    apart = []
    for k in range(10):
        run = sweep(f"run{'x' * k}")
        corner = (np.abs(run.velocity_rad_s) > 2.0) & (np.abs(run.sensor_nm) > 30.0)
        apart.append(replace(run, scored=run.scored & ~corner))
    (advice,) = card_of(apart).advice
    assert advice.key == "corners"
    assert "2 to 3 rad/s at 75 to 100 % of rated torque" in advice.text


def test_edges() -> None:
    assert speed_edges(3.0) == (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0)
    assert speed_edges(0.011) == (0.0, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.011)
    assert load_edges([sweep("run")])[0] == -1.0
    far = sweep("run")
    assert load_edges([replace(far, sensor_nm=1.45 * far.sensor_nm)])[-1] == 1.5
    assert temperature_edges([sweep("run")]) == (20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)


def test_the_command_writes_page_pictures_and_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("jinja2")
    pytest.importorskip("matplotlib")
    base = tmp_path
    write_models(base / "models")
    (base / "models" / "joint2.yaml").unlink()
    (base / "models" / "joint1.yaml").rename(base / "models" / "joint_1.yaml")  # as jtq init names it
    (base / "models" / "joint1.fused.onnx").unlink()
    (base / "runs").mkdir()
    for day in range(2):
        write_run(base / "runs" / f"day_{day}.csv.gz", emulated(1, "variable", 2.0, day=day))
    arguments = [str(base / "runs"), "--models", str(base / "models"), "--out", str(base / "out")]
    assert main([*arguments, "--card"]) == 0
    shown = capsys.readouterr().out
    assert "method fused; 2 runs" in shown
    assert "what to measure next" in shown
    values = json.loads((base / "out" / "card.json").read_text())
    assert values["schema"] == "jtq.accuracy/1"
    (joint,) = values["joints"]
    assert joint["method"] == "fused"
    assert joint["baseline"]["rmse_nm"] > 0.0
    assert f"RMSE           {joint['error']['rmse_nm']:.2g} Nm" in shown
    page = (base / "out" / "card.html").read_text()
    assert page.count("<svg") == 1
    assert "paper" not in re.sub(r"<style.*?</style>|<svg.*?</svg>", "", page, flags=re.DOTALL)
    picture = (base / "out" / "card_joint1.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert not (base / "out" / "evaluation.html").exists()
    (base / "models" / "joint1.yaml").write_bytes((base / "models" / "joint_1.yaml").read_bytes())
    assert main([*arguments, "--card"]) == 1
    assert "found joint_1.yaml and joint1.yaml, expected one" in capsys.readouterr().err
    with pytest.raises(SystemExit) as refused:
        main([*arguments, "--card", "--outside", str(base / "runs")])
    assert refused.value.code == 2
