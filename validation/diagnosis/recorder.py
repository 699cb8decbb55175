"""A recorder as they are: takes runs and returns what such a recorder would have written. Pure: run, settings, seed.

The columns of a run are taken as the true signals at their stamps. In this order: the drive filters its velocities, each
channel is as old as its bus makes it, the recorder polls the newest value at its own rate, rows get lost, stamps are
written with their errors, angles are wrapped, numbers get the digits of the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from validation.diagnosis.entries import Array, Columns

TIME: Final = "time_s"


@dataclass(frozen=True)
class Recorder:
    """digits: significant ones; decimals: fixed ones instead, of all columns but time; float32: single precision instead.

    rate_hz: of polling; None: every row. sampling_jitter, stamp_jitter: standard deviation as part of a step: the
    first moves the moment of polling and its stamp, the second the stamp alone. stamp_step_s: stamps are rounded down to
    it; of rows with equal stamps the first is kept. lost: share of rows that are missing, in losses of `lost_rows` on
    average. age_s: how old each quantity is when it is polled; held_hz: quantities that change at this rate only.
    velocity_filter_s: time constant of the drive's low-pass on its velocities. wrapped: angles within [-pi, pi).
    one_file: all runs in one table, `pause_s` apart.
    """

    digits: int = 12
    decimals: int | None = None
    float32: bool = False
    rate_hz: float | None = None
    sampling_jitter: float = 0.0
    stamp_jitter: float = 0.0
    stamp_step_s: float = 0.0
    lost: float = 0.0
    lost_rows: float = 1.0
    age_s: Mapping[str, float] = field(default_factory=dict)
    held_hz: Mapping[str, float] = field(default_factory=dict)
    velocity_filter_s: float = 0.0
    wrapped: bool = False
    one_file: bool = False
    pause_s: float = 5.0

    def __post_init__(self) -> None:
        if not 1 <= self.digits <= 17:
            raise ValueError(f"digits: found {self.digits}, expected 1 to 17")
        if not 0.0 <= self.lost < 1.0 or self.lost_rows < 1.0:
            raise ValueError(
                f"lost, lost_rows: found {self.lost}, {self.lost_rows}, expected 0 <= lost < 1 <= lost_rows"
            )
        if any(age < 0.0 for age in self.age_s.values()):
            raise ValueError("age_s: found a negative age, expected what a recorder can have")

    @property
    def explains(self) -> frozenset[str]:
        """Effects that this recorder itself puts into the runs: naming them is not wrong."""
        return frozenset({"channel_delay"} if self.age_s else ())


PRESETS: Final[dict[str, Recorder]] = {
    "full": Recorder(),
    "seven_digits": Recorder(digits=7),
    "six_digits": Recorder(digits=6),
    "five_digits": Recorder(digits=5),
    "float32": Recorder(float32=True),
    "four_decimals": Recorder(decimals=4),
    "500_hz": Recorder(rate_hz=500.0),
    "250_hz": Recorder(rate_hz=250.0),
    "100_hz": Recorder(rate_hz=100.0),
    "50_hz": Recorder(rate_hz=50.0),
    "jitter": Recorder(sampling_jitter=0.1),
    "wrong_stamps": Recorder(stamp_jitter=0.1),
    "rounded_stamps": Recorder(rate_hz=300.0, stamp_step_s=1e-3),
    "rows_missing": Recorder(lost=0.005, lost_rows=2.0),
    "ages": Recorder(
        age_s={"torque_nm": 0.0015, "link_position_rad": 0.0005, "link_velocity_rad_s": 0.0005},
        held_hz={"temperature_c": 10.0},
    ),
    "drive_velocity": Recorder(velocity_filter_s=0.004),
    "wrapped": Recorder(wrapped=True),
    "one_file": Recorder(one_file=True),
    "workshop": Recorder(
        digits=7,
        rate_hz=250.0,
        sampling_jitter=0.05,
        stamp_step_s=1e-4,
        lost=0.002,
        velocity_filter_s=0.002,
        held_hz={"temperature_c": 10.0},
    ),
}
"""Names of `--recorder`."""


def record(runs: Sequence[Columns], recorder: Recorder, seed: int) -> list[Columns]:
    """Return the tables that the recorder writes of these runs: one per run, or one of all.

    The values are those of the text: `float` of a cell of `csv_text` gives them back.
    """
    tables = [_polled(run, recorder, np.random.default_rng([seed, k])) for k, run in enumerate(runs)]
    if recorder.one_file:
        tables = [_joined(tables, recorder.pause_s)]
    return [_written(table, recorder) for table in tables]


def csv_text(table: Columns, recorder: Recorder) -> str:
    cells = [_cells(name, x, recorder) for name, x in table.items()]
    rows = [",".join(row) for row in zip(*cells, strict=True)]
    return "\n".join([",".join(table), *rows]) + "\n"


def _polled(run: Columns, recorder: Recorder, rng: np.random.Generator) -> Columns:
    """Return the rows that are polled, with their stamps; angles as they are."""
    t = run[TIME]
    source = float(np.median(np.diff(t)))
    step = source if recorder.rate_hz is None else 1.0 / recorder.rate_hz
    at = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    at = at + np.clip(recorder.sampling_jitter * rng.normal(size=len(at)), -0.45, 0.45) * step
    at = np.clip(at, t[0], t[-1])
    kept = ~_losses(len(at), recorder, rng)
    kept[0] = True
    stamps = at + np.clip(recorder.stamp_jitter * rng.normal(size=len(at)), -0.45, 0.45) * step
    if recorder.stamp_step_s:
        stamps = recorder.stamp_step_s * np.floor(stamps / recorder.stamp_step_s + 1e-6)
    at, stamps = at[kept], stamps[kept]
    first = np.concatenate(([True], np.diff(stamps) > 1e-9))
    at, stamps = at[first], stamps[first]
    out = {TIME: stamps}
    for name, x in run.items():
        if name == TIME:
            continue
        quantity = name.rpartition(".")[2]
        values = x
        if recorder.velocity_filter_s and quantity.endswith("velocity_rad_s"):
            values = low_pass(x, recorder.velocity_filter_s, source)
        moment = at
        if quantity in recorder.held_hz:
            moment = np.floor(at * recorder.held_hz[quantity]) / recorder.held_hz[quantity]
        out[name] = _newest(t, values, moment - recorder.age_s.get(quantity, 0.0), source)
    return out


def _losses(n: int, recorder: Recorder, rng: np.random.Generator) -> Array:
    """Return which rows are lost [n]: losses begin at random, their lengths are geometric."""
    lost = np.zeros(n, bool)
    if recorder.lost:
        for begin in np.flatnonzero(rng.uniform(size=n) < recorder.lost / recorder.lost_rows):
            lost[begin : begin + rng.geometric(1.0 / recorder.lost_rows)] = True
    return lost


def _newest(t: Array, x: Array, at: Array, step: float) -> Array:
    """Return x as it was at `at`: what a poll finds is the newest value, but of one that a bus delays by a part of a step
    the source itself has sampled another moment: linear between rows.
    """
    place = np.clip((at - t[0]) / step, 0.0, len(t) - 1.0)
    if np.allclose(np.diff(t), step, atol=1e-6):
        k = np.floor(place + 1e-6).astype(int)
        if np.allclose(place, k, atol=1e-5):
            newest: Array = x[k]
            return newest
    linear: Array = np.interp(at, t, x)
    return linear


def low_pass(x: Array, constant_s: float, step_s: float) -> Array:
    """Return x through a first-order low-pass, settled at the first sample."""
    a = float(np.exp(-step_s / constant_s))
    y = np.empty(len(x))
    state = float(x[0])
    for k, value in enumerate(x.tolist()):
        state = a * state + (1.0 - a) * value
        y[k] = state
    return y


def _joined(tables: Sequence[Columns], pause_s: float) -> Columns:
    begin, times = 0.0, []
    for table in tables:
        times.append(table[TIME] - table[TIME][0] + begin)
        begin = float(times[-1][-1]) + pause_s
    joined = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return {**joined, TIME: np.concatenate(times)}


def _written(table: Columns, recorder: Recorder) -> Columns:
    if recorder.wrapped:
        table = {
            name: (x + np.pi) % (2.0 * np.pi) - np.pi if name.endswith("position_rad") else x
            for name, x in table.items()
        }
    return {name: np.array([float(cell) for cell in _cells(name, x, recorder)]) for name, x in table.items()}


def _cells(name: str, x: Array, recorder: Recorder) -> list[str]:
    """Return the text of each value. Time keeps its microseconds where the file has fixed decimals or single precision:
    recorders stamp with integers or doubles.
    """
    if recorder.decimals is not None:
        form = ".6f" if name == TIME else f".{recorder.decimals}f"
        return [format(value, form) for value in x.tolist()]
    if recorder.float32 and name != TIME:
        return [format(value, ".9g") for value in x.astype(np.float32).tolist()]
    form = f".{recorder.digits}g"
    return [format(value, form) for value in x.tolist()]
