"""Stamps that were printed in few digits: equal steps are found again, and nothing else is taken for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.runs.files import read_run, read_runs
from jtqd.sysid.runs.run_file import even_stamps


def printed(time_s: FloatArray, format_: str) -> FloatArray:
    return np.array([float(format(t, format_)) for t in time_s.tolist()])


def truncated(time_s: FloatArray, decimals: int) -> FloatArray:
    return np.floor(time_s * 10.0**decimals + 1e-6) / 10.0**decimals


def grid(rate_hz: float, seconds: float = 60.0, first: float = 0.0) -> FloatArray:
    return first + np.arange(round(seconds * rate_hz)) / rate_hz


@pytest.mark.parametrize("digits", [5, 6, 7])
@pytest.mark.parametrize("first", [0.0, 0.0003, 12.5])
def test_a_kilohertz_is_found_again_from_its_significant_digits(digits: int, first: float) -> None:
    true = grid(1000.0, first=first)
    even = even_stamps(printed(true, f".{digits}g"))
    assert even is not None
    off = even - true
    assert np.ptp(off) < 1e-6, "within a microsecond, but for when it began"
    assert np.max(np.abs(off)) < (1e-6 if first < 1.0 else 0.6 * 10.0 ** (2 - digits))


@pytest.mark.parametrize(
    ("rate", "format_", "within"),
    [
        (333.3, ".3f", 1e-3),
        (300.0, ".3f", 3e-4),
        (1000.0 / 3.0, ".3f", 1e-4),
        (666.6, ".3f", 3e-4),
        (2000.0, ".3f", 1e-6),
        (1000.0, ".2f", 1e-6),
        (99.87, ".2f", 6e-3),
        (400.0, ".5g", 1e-6),
        (250.0, ".3g", 1e-6),
    ],
)
def test_nominal_rates_are_met_in_their_printed_digits(rate: float, format_: str, within: float) -> None:
    true = grid(rate)
    even = even_stamps(printed(true, format_))
    assert even is not None
    assert np.max(np.abs(even - true)) < within
    assert np.ptp(np.diff(even)) < 1e-9


def test_stamps_that_were_cut_off_are_early_by_half_a_digit() -> None:
    true = grid(300.0, 20.0)
    even = even_stamps(truncated(true, 3))
    assert even is not None
    assert np.ptp(even - true) < 1e-5
    assert np.max(np.abs(even - true)) < 1e-3


@pytest.mark.parametrize("format_", [".6f", ".7g", ".9g"])
@pytest.mark.parametrize("jitter_s", [3e-5, 2e-4])
def test_stamps_that_jitter_are_left_alone(format_: str, jitter_s: float) -> None:
    rng = np.random.default_rng(3)
    true = grid(1000.0, 20.0)
    assert even_stamps(printed(np.sort(true + rng.normal(scale=jitter_s, size=len(true))), format_)) is None


def test_a_clock_that_drifts_is_left_alone() -> None:
    true = grid(1000.0)
    assert even_stamps(printed(true + 2e-6 * true**2, ".6f")) is None


@pytest.mark.parametrize("lost", [[700], [700, 701, 702], [100, 2000, 2001, 9000]])
@pytest.mark.parametrize(("rate", "format_"), [(300.0, ".3f"), (1000.0, ".7g"), (333.3, ".4f")])
def test_lost_rows_stay_lost(lost: Sequence[int], rate: float, format_: str) -> None:
    true = np.delete(grid(rate, 40.0), lost)
    even = even_stamps(printed(true, format_))
    assert even is not None
    assert np.max(np.abs(even - true)) < 6e-4
    assert (
        np.flatnonzero(np.diff(even) > 1.5 / rate).tolist()
        == np.flatnonzero(np.diff(true) > 1.5 / rate).tolist()
    )


def write(path: Path, time_s: FloatArray, format_: str, true: FloatArray) -> None:
    rows = [f"{t:{format_}},{np.sin(3.0 * s):.9f},{np.cos(s):.4f}" for t, s in zip(time_s, true, strict=True)]
    path.write_text("\n".join(["time_s,j1.motor_position_rad,j1.current_a", *rows]) + "\n")


def test_the_reader_of_a_diagnosis_takes_equal_steps_and_notes_what_matters(tmp_path: Path) -> None:
    fine, coarse, jitter = (tmp_path / name for name in ("fine.csv", "coarse.csv", "jitter.csv"))
    write(fine, grid(1000.0, 20.0), ".7g", grid(1000.0, 20.0))
    write(coarse, grid(300.0, 20.0), ".3f", grid(300.0, 20.0))
    noise = np.random.default_rng(1).uniform(-2e-4, 2e-4, 20_000)
    write(jitter, grid(1000.0, 20.0) + noise + 1.0, ".6f", grid(1000.0, 20.0) + 40.0)
    one, two, three = read_runs([fine, coarse, jitter], segments=True)
    assert np.max(np.abs(one.table.time_s - grid(1000.0, 20.0))) < 1e-6
    assert np.max(np.abs(two.table.time_s - grid(300.0, 20.0))) < 3e-4
    assert one.notes == ()
    assert ["equal steps used" in note for note in two.notes] == [True]
    assert np.array_equal(three.table.time_s, read_run(jitter).table.time_s)
    assert three.notes == ()


def test_a_gap_stays_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    true = np.concatenate((grid(300.0, 10.0), grid(300.0, 10.0, first=14.0017)))
    write(path, true, ".3f", true)
    one, two = read_runs([path], segments=True)
    assert one.table.time_s[-1] == pytest.approx(true[2999], abs=6e-4)
    assert two.table.time_s[0] == pytest.approx(true[3000], abs=6e-4)
    assert np.ptp(np.diff(two.table.time_s)) < 1e-9
