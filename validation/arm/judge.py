"""The judge of external torque: figures of what an estimator published over days of the foreign arm, beside their limits.

An estimator is judged by the truth of the plant alone. Figures count after LEARN_S of a day; `free` is all time but contacts
and SETTLED_S after each. What was not published where it could be has figures of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import mujoco
import numpy as np

from validation.arm.arm import (
    CYCLE_S,
    FALL_S,
    JOINTS,
    Arm,
    Array,
    Contact,
    Readings,
    Run,
    Truth,
    limits,
    rigid,
)
from validation.arm.trial import LEARN_S, LEVER_M
from validation.study import percent, wilson

GAUSS: Final = 1.645
"""Sigmas of a 90 % interval."""
SETTLED_S: Final = 0.5
ONE_ALARM_S: Final = 1.0
LOOKED_S: Final = 0.2
"""So long after full force link, point and strength are looked at."""
POINT_FROM: Final = 3
"""Links with so many joints before them have a contact point to be judged."""
LIGHTEST_KG: Final = 0.5
SCALE_M: Final = 0.25
"""Torques of a wrench count as forces at this distance."""
WELL: Final = 20.0
"""A pose is well-conditioned where the tool's wrench is at most so many times less certain in one way than in another,
were all joints as sure as they are strong: what the pose itself allows."""
EVERY: Final = 50
"""Cycles between the poses at which wrenches are judged."""
BINS_N: Final = (5.0, 8.0, 12.0, 17.0, 25.0, 38.0, 60.0)

# To reach (the table of the project's external torque); (typical, bad_day) where they differ
RMS: Final = {"typical": 0.02, "bad_day": 0.035}
TO_BASELINE: Final = 0.4
INSIDE: Final = (0.84, 0.95)
PUBLISHED: Final = 0.95
"""Share of cycles, and of well-conditioned poses, that have a value: else leaving out what is hard would be rewarded."""
MASS, CENTRE_M = 0.03, 0.01
"""Of half of the days: 10 s of some motions tell little, whoever looks (`baseline.best_payload`)."""
WITHIN_S: Final = {"push": 0.02, "clamp": 0.3}
"""Reported within so long of full force."""
DETECTED: Final = 0.95
ALARMS_PER_H: Final = 1.0 / 3.0
LINK, POINT_M = 0.95, 0.05
TELLS: Final = 2.0
"""A contact can tell its link where the link's own joint feels so many times RMS."""
WRENCH: Final = 1.3
COST_US: Final = 80.0


class Published(NamedTuple):
    """What an estimator publishes every cycle, known at its end; NaN where it has nothing.

    external_nm, sigma_nm [n, 7]; wrench [n, 6]: force and torque about the tool's origin, base axes; payload_kg [n],
    centre_m [n, 3] in the tool's frame; contact [n]: link 1..7 or 0; strength_n [n]; since_s [n]; point_m [n, 3]: in the
    frame of that link.
    """

    external_nm: Array
    sigma_nm: Array
    wrench: Array
    payload_kg: Array
    centre_m: Array
    contact: Array
    strength_n: Array
    since_s: Array
    point_m: Array


def nothing(n: int) -> Published:
    """Return the outputs of an estimator that knows nothing."""
    empty = np.full(n, np.nan)
    return Published(
        np.full((n, JOINTS), np.nan),
        np.full((n, JOINTS), np.nan),
        np.full((n, 6), np.nan),
        empty.copy(),
        np.full((n, 3), np.nan),
        np.zeros(n, np.int8),
        empty.copy(),
        empty.copy(),
        np.full((n, 3), np.nan),
    )


def of_the_past(run: Callable[[Readings], Published], readings: Readings, published: Published) -> bool:
    """Return whether an estimator publishes the same of a day whose last part has not come yet."""
    cut = 3 * len(readings.time_s) // 5
    again = run(Readings(*(each[:cut] for each in readings)))
    return all(
        np.array_equal(one, other[:cut], equal_nan=True) for one, other in zip(again, published, strict=True)
    )


class Event(NamedTuple):
    """One contact: reported after its full force by delay_s, infinite for never. named: 0, or the link that was named."""

    kind: str
    link: int
    force_n: float
    lever_m: float
    own_share: float
    delay_s: float
    named: int
    point_off_m: float
    strength_off: float
    since_off_s: float


class Found(NamedTuple):
    """Of one run: counts and sums over free cycles [7], mean square under full force [7], contacts, false alarms, payload,
    wrenches; claimed, silent: cycles of joints without a torque that have an external torque all the same, and all of them.
    Wrenches [2]: free, and while the tool is pushed.

    Errors of a payload: infinite where none is published, NaN where none is judged.
    """

    cycles: Array
    published: Array
    square: Array
    inside: Array
    pushed: Array
    events: list[Event]
    alarms: int
    free_s: float
    mass_off: float
    centre_off_m: float
    wrench_square: Array
    wrenches: Array
    poses: int
    claimed: int
    silent: int


def free_cycles(run: Run, n: int, after_s: float = SETTLED_S) -> Array:
    """Return which cycles [n] count as free of contact."""
    t = CYCLE_S * np.arange(n)
    free = t >= LEARN_S
    for contact in run.contacts:
        free &= (t < contact.start_s) | (t > contact.end_s + FALL_S + after_s)
    return np.asarray(free)


def judge(arm: Arm, run: Run, truth: Truth, readings: Readings, published: Published) -> Found:
    """Return what one run tells of an estimator."""
    n = len(truth.link_rad)
    free = free_cycles(run, n)
    error = published.external_nm - truth.external_nm
    silent = run.silent(n)
    due = free[:, None] & ~run.silent(n, SETTLED_S)
    there = due & np.isfinite(error) & np.isfinite(published.sigma_nm)
    square = np.where(there, error / arm.rated_nm, 0.0) ** 2
    inside = there & (np.abs(error) <= GAUSS * published.sigma_nm)
    began = np.flatnonzero(np.diff((published.contact != 0).astype(np.int8), prepend=0) == 1)
    at = round(LEARN_S / CYCLE_S)
    off = np.array([np.nan, np.nan])
    if run.payload.mass_kg >= LIGHTEST_KG and n > at:
        off[0] = abs(published.payload_kg[at] / run.payload.mass_kg - 1.0)
        off[1] = np.linalg.norm(published.centre_m[at] - np.array(run.payload.centre_m))
        off[np.isnan(off)] = np.inf
    wrench = _wrenches(run, truth, readings, published, free & ~silent.any(axis=1))
    return Found(
        due.sum(axis=0),
        there.sum(axis=0),
        square.sum(axis=0),
        inside.sum(axis=0),
        _pushed(run, error / arm.rated_nm),
        [
            _event(arm, contact, truth, published, began)
            for contact in run.contacts
            if contact.end_s < n * CYCLE_S
        ],
        _alarms(began[free[began]]),
        float(free.sum()) * CYCLE_S,
        float(off[0]),
        float(off[1]),
        *wrench,
        int((silent & np.isfinite(published.external_nm)).sum()),
        int(silent.sum()),
    )


def _pushed(run: Run, share: Array) -> Array:
    """Return the mean square error [7] while contacts have their full force, NaN without any."""
    t = CYCLE_S * np.arange(len(share))
    full = np.any([(t > c.full_s) & (t < c.end_s) for c in run.contacts] or [t < 0.0], axis=0)
    squares = np.nan_to_num(share[full] ** 2, nan=np.inf)
    return np.asarray(squares.mean(axis=0)) if full.any() else np.full(JOINTS, np.nan)


def _alarms(began: Array) -> int:
    """Return how many false alarms these first cycles are; what comes within ONE_ALARM_S of the last one is the same."""
    return int((np.diff(began, prepend=-np.inf) * CYCLE_S > ONE_ALARM_S).sum())


def _event(arm: Arm, contact: Contact, truth: Truth, published: Published, began: Array) -> Event:
    start, full = (round(x / CYCLE_S) for x in (contact.start_s, contact.full_s))
    end, look = round(contact.end_s / CYCLE_S), full + round(LOOKED_S / CYCLE_S)
    reported = began[(began >= start) & (began <= end)]
    delay = (reported[0] - full) * CYCLE_S if len(reported) else np.inf
    force = float(np.linalg.norm(contact.force_n))
    felt = np.abs(truth.external_nm[look])
    named = int(published.contact[look])
    point = (
        np.linalg.norm(published.point_m[look] - np.array(contact.point_m))
        if named == contact.link
        else np.nan
    )
    return Event(
        contact.kind,
        contact.link,
        force,
        float(felt.max()) / force,
        float(felt[contact.link - 1] / arm.rated_nm[contact.link - 1]),
        float(delay),
        named,
        float(point),
        float(abs(published.strength_n[look] / force - 1.0)) if named else np.nan,
        float(abs(published.since_s[look] - contact.start_s)) if named else np.nan,
    )


def tool_jacobians(link_rad: Array) -> Array:
    """Return the tool's Jacobians [n, 6, 7] at positions [n, 7], base axes: tau = J' wrench."""
    model = rigid()
    data, tool = mujoco.MjData(model), model.site("tool").id
    found = np.zeros((len(link_rad), 6, JOINTS))
    for q, out in zip(link_rad, found, strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, out[:3], out[3:], tool)
    return found


def wrench_information(jacobian: Array, sigma_nm: Array) -> tuple[Array, Array]:
    """Return by joints' sigmas [n, 7] the inverse covariance [n, 6, 6] of the tool's wrench, and its conditioning [n].

    A joint without a sigma tells nothing.
    """
    whitened = np.nan_to_num(jacobian / sigma_nm[:, None, :])
    information = whitened @ whitened.transpose(0, 2, 1)
    scaled = whitened * np.array([1.0, 1.0, 1.0, SCALE_M, SCALE_M, SCALE_M])[:, None]
    values = np.linalg.svd(scaled, compute_uv=False)
    return information, values[:, 0] / np.maximum(values[:, -1], 1e-12)


def _wrenches(
    run: Run, truth: Truth, readings: Readings, published: Published, free: Array
) -> tuple[Array, Array, int]:
    """Return the sum of e' W^-1 e / 6 and their number, free and while the tool is pushed [2]; well-conditioned poses."""
    n = len(free)
    t, pushed = CYCLE_S * np.arange(n), np.zeros(len(free), bool)
    for contact in run.contacts:
        if contact.link == JOINTS:
            pushed |= (t > contact.full_s + LOOKED_S) & (t < contact.end_s)
    chosen = np.flatnonzero(free | pushed)[::EVERY]
    sigma = readings.sigma_nm[chosen]
    jacobian = tool_jacobians(truth.link_rad[chosen])
    information = wrench_information(jacobian, sigma)[0]
    condition = wrench_information(jacobian, np.broadcast_to(limits()["rated_nm"], sigma.shape))[1]
    well = condition <= WELL
    error = (published.wrench - truth.wrench)[chosen][well]
    there = np.isfinite(error).all(axis=1)
    squares = np.einsum("ni,nij,nj->n", error[there], information[well][there], error[there]) / 6.0
    during = pushed[chosen][well][there].astype(np.intp)
    return np.bincount(during, squares, 2), np.bincount(during, minlength=2), int(well.sum())


class Row(NamedTuple):
    """A figure: its limit in words, values by method as text, whether the judged method reaches it (None: no limit)."""

    what: str
    limit: str
    cells: Sequence[str]
    reached: bool | None = None


class Figures(NamedTuple):
    """All runs of one method together; shares are of 1. mass, centre_m: half of the days, and nine of ten, are within."""

    rms: Array
    pushed: Array
    inside: Array
    published: float
    claimed: tuple[int, int]
    mass: tuple[float, float]
    centre_m: tuple[float, float]
    detected: dict[str, tuple[int, int]]
    delay_s: dict[str, float]
    alarms: int
    hours: float
    link: tuple[int, int]
    point_m: float
    strength: float
    since_s: float
    wrench: float
    wrenches: float
    curve: list[tuple[int, int]]


def figures(found: Sequence[Found], plant: str) -> Figures:
    """Return the figures of runs, at least one."""
    cycles, published, square, inside = (
        np.sum([getattr(each, key) for each in found], axis=0)
        for key in ("cycles", "published", "square", "inside")
    )
    events = [event for each in found for event in each.events]
    named = [e for e in events if e.named and e.own_share >= TELLS * RMS[plant]]
    points = [e.point_off_m for e in named if e.link >= POINT_FROM and e.named == e.link]
    squares, wrenches = (
        np.sum([getattr(each, key) for each in found], axis=0) for key in ("wrench_square", "wrenches")
    )
    poses = sum(each.poses for each in found)
    pushed = [each.pushed for each in found if not np.isnan(each.pushed).any()]
    heavy = [each for each in found if not np.isnan(each.mass_off)]
    return Figures(
        np.sqrt(np.where(published > 0, square / np.maximum(published, 1), np.inf)),
        np.sqrt(np.mean(pushed, axis=0)) if pushed else np.full(JOINTS, np.nan),
        inside / np.maximum(published, 1),
        float((published / np.maximum(cycles, 1)).min()),
        (sum(each.claimed for each in found), sum(each.silent for each in found)),
        _within_of([each.mass_off for each in heavy]),
        _within_of([each.centre_off_m for each in heavy]),
        {kind: _within(events, kind, limit) for kind, limit in WITHIN_S.items()},
        {kind: _median([e.delay_s for e in events if _counts(e, kind)]) for kind in WITHIN_S},
        sum(each.alarms for each in found),
        sum(each.free_s for each in found) / 3600.0,
        (sum(e.named == e.link for e in named), len(named)),
        _median(points),
        _median([e.strength_off for e in events if e.named]),
        _median([e.since_off_s for e in events if e.named]),
        # the worse of both: most of the time nothing pushes, and an estimate of nothing is right
        float(np.sqrt(squares[wrenches > 0] / wrenches[wrenches > 0]).max()) if wrenches.any() else np.inf,
        float(np.sum(wrenches)) / max(poses, 1),
        [
            _share(
                [
                    e.delay_s <= WITHIN_S["push"]
                    for e in events
                    if e.kind in ("push", "curve") and low <= e.force_n < high
                ]
            )
            for low, high in pairwise(BINS_N)
        ],
    )


def _counts(event: Event, kind: str) -> bool:
    return event.kind == kind and event.lever_m >= 0.95 * LEVER_M


def _within(events: Sequence[Event], kind: str, limit_s: float) -> tuple[int, int]:
    return _share([e.delay_s <= limit_s for e in events if _counts(e, kind)])


def _share(good: Sequence[bool]) -> tuple[int, int]:
    return sum(good), len(good)


def _within_of(values: Sequence[float]) -> tuple[float, float]:
    half, most = np.quantile(values, (0.5, 0.9), method="higher") if len(values) else (np.nan, np.nan)
    return float(half), float(most)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else np.nan


def rows(plant: str, made: Sequence[Figures], cost_us: float = np.nan, past: bool | None = None) -> list[Row]:
    """Return the table of a plant; made: of the judged method, of the baseline, of more; past: `of_the_past`."""
    one, baseline = made[0], made[1]
    ratio = float((one.rms / baseline.rms).max())
    low, high = INSIDE
    table = [
        Row(
            "external torque without contact, rms, worst joint, % of rated",
            f"{100 * RMS[plant]:g}",
            [f"{100 * f.rms.max():.2f}" for f in made],
            bool(one.rms.max() <= RMS[plant]),
        ),
        Row("joints 1 to 7", "", [" ".join(f"{100 * x:.2f}" for x in f.rms) for f in made]),
        Row("the same under full force", "", [f"{100 * f.pushed.max():.2f}" for f in made]),
        Row("to the baseline's, worst joint", f"{TO_BASELINE:g}", [f"{ratio:.2f}"], ratio <= TO_BASELINE),
        Row(
            "90 % interval holds, worst to best joint",
            f"{100 * low:.0f} to {100 * high:.0f} %",
            [f"{percent(f.inside.min())} to {percent(f.inside.max())}" for f in made],
            bool(low <= one.inside.min() and one.inside.max() <= high),
        ),
        Row(
            "cycles with external torque, worst joint",
            f"{100 * PUBLISHED:.0f} %",
            [percent(f.published) for f in made],
            one.published >= PUBLISHED,
        ),
        Row(
            "a joint without torque: cycles with its external torque",
            "none",
            [percent(f.claimed[0] / f.claimed[1]) if f.claimed[1] else "none" for f in made],
            one.claimed[0] == 0,
        ),
        Row(
            "payload, mass: half of the days; nine of ten",
            f"{100 * MASS:.0f} %",
            [f"{percent(f.mass[0])}; {percent(f.mass[1])}" for f in made],
            one.mass[0] <= MASS,
        ),
        Row(
            "payload, centre: half of the days; nine of ten",
            f"{100 * CENTRE_M:g} cm",
            [f"{100 * f.centre_m[0]:.1f}; {100 * f.centre_m[1]:.1f} cm" for f in made],
            one.centre_m[0] <= CENTRE_M,
        ),
    ]
    for kind, limit in WITHIN_S.items():
        good, count = one.detected[kind]
        table.append(
            Row(
                f"{kind} of 20 N reported within {1000 * limit:.0f} ms of full force",
                f"{100 * DETECTED:.0f} %",
                [f"{_ratio(f.detected[kind])}, median {1000 * f.delay_s[kind]:.0f} ms" for f in made],
                count > 0 and good / count >= DETECTED,
            )
        )
    rate = one.alarms / max(one.hours, 1e-9)
    good, count = one.link
    table += [
        Row(
            "false alarms",
            "1 in 3 h",
            [f"{f.alarms} in {f.hours:.2f} h" for f in made],
            rate <= ALARMS_PER_H and one.hours > 0.0,
        ),
        Row(
            "link of the contact right",
            f"{100 * LINK:.0f} %",
            [_ratio(f.link) for f in made],
            count > 0 and good / count >= LINK,
        ),
        Row(
            "contact point, median",
            f"{100 * POINT_M:.0f} cm",
            [f"{100 * f.point_m:.1f} cm" for f in made],
            one.point_m <= POINT_M,
        ),
        Row("strength, median error", "", [percent(f.strength) for f in made]),
        Row("since when, median error", "", [f"{1000 * f.since_s:.0f} ms" for f in made]),
        Row(
            "wrench at the tool to what the joints' sigmas allow, rms",
            f"{WRENCH:g}",
            [f"{f.wrench:.2f}" for f in made],
            one.wrench <= WRENCH,
        ),
        Row(
            "well-conditioned poses with a wrench",
            f"{100 * PUBLISHED:.0f} %",
            [percent(f.wrenches) for f in made],
            one.wrenches >= PUBLISHED,
        ),
        Row(
            "cost of a cycle",
            f"{COST_US:.0f} us",
            [f"{cost_us:.0f} us"],
            None if np.isnan(cost_us) else cost_us <= COST_US,
        ),
        Row("published of the past alone", "yes", [{True: "yes", False: "no", None: ""}[past]], past),
    ]
    return table


def curve_rows(made: Sequence[Figures]) -> list[Row]:
    """Return the share of pushes reported in time, by force."""
    return [
        Row(f"{low:g} to {high:g} N", "", [_ratio(f.curve[k]) for f in made])
        for k, (low, high) in enumerate(pairwise(BINS_N))
    ]


def _ratio(share: tuple[int, int]) -> str:
    good, count = share
    if not count:
        return "none"
    low, high = wilson(good, count)
    return f"{percent(good / count)} ({100 * low:.0f} to {100 * high:.0f}) of {count}"


def oracle(arm: Arm, run: Run, truth: Truth, readings: Readings) -> Published:
    """Return the best that joints as wrong as these allow: the true model, and the truth about payload and contact."""
    n = len(truth.link_rad)
    external = truth.external_nm + readings.torque_nm - truth.drive_nm
    out = nothing(n)._replace(external_nm=external, sigma_nm=readings.sigma_nm.copy())
    jacobian = tool_jacobians(truth.link_rad)
    information, _ = wrench_information(jacobian, readings.sigma_nm)
    weighted = np.nan_to_num(external / readings.sigma_nm**2)[:, :, None]
    out.wrench[:] = np.linalg.solve(information + 1e-9 * np.eye(6), jacobian @ weighted)[:, :, 0]
    out.payload_kg[:], out.centre_m[:] = run.payload.mass_kg, run.payload.centre_m
    for contact in run.contacts:
        first, last = round(contact.start_s / CYCLE_S) + 1, round((contact.end_s + FALL_S) / CYCLE_S)
        out.contact[first:last], out.since_s[first:last] = contact.link, contact.start_s
        out.point_m[first:last], out.strength_n[first:last] = contact.point_m, np.linalg.norm(contact.force_n)
    return out


def zero(arm: Arm, readings: Readings, plant: str) -> Published:
    """Return an estimator that says that nothing ever pushes."""
    n = len(readings.time_s)
    out = nothing(n)._replace(external_nm=np.zeros((n, JOINTS)))
    out.sigma_nm[:] = RMS[plant] * arm.rated_nm
    out.wrench[:], out.payload_kg[:], out.centre_m[:] = 0.0, 0.0, 0.0
    return out
