"""The diagnosis from run tables and joint files to findings: the order of its steps.

tables -> signals -> binned dataset -> (outlier runs out, again) -> noise -> search -> refinement -> (events out, again)
-> verdict
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.dataset import (
    Dataset,
    build_dataset,
    piece_notes,
    recordings,
    resolution_notes,
    too_little,
    usable_signals,
)
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    EVERYTHING,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    Findings,
    OutlierRun,
    Scope,
    shows_at,
)
from jtqd.sysid.diagnosis.limits import RELEVANCE
from jtqd.sysid.diagnosis.model import Solution, solve
from jtqd.sysid.diagnosis.next_experiment import each_joint, next_experiment
from jtqd.sysid.diagnosis.outlier_runs import outlier_run
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.diagnosis.smoothing import noise_of
from jtqd.sysid.diagnosis.unexplained import events_left, remaining
from jtqd.sysid.diagnosis.verdict import conclude, present_of
from jtqd.sysid.runs.checks import may_leave_out

_WORST_FIRST: Final = (UNEXPLAINED, AMBIGUOUS, CAUSE, INSUFFICIENT, NO_GAP)


def diagnose(
    runs: Sequence[tuple[str, RunTable]],
    joints: Mapping[int, Joint],
    scope: Scope = EVERYTHING,
    *,
    relevance: float = RELEVANCE,
    trust: Mapping[str, float] = MappingProxyType({}),
) -> Findings:
    """Return what the joint files' simulation gets wrong in these runs.

    runs: (name, table); joints: nominal joint per number; scope: what may be named; relevance: part of the rated torque,
    rms over a run, from which what the causes leave matters; trust: factors of priors by their names. Data that cannot serve
    give the verdict insufficient_data with its reasons. Joints with a sensor each are diagnosed one by one. Where a cause
    has the name of an effect that a file already has, the diagnosis is made again without that effect, so that what is
    reported is the whole of it.
    """
    numbers = tuple(sorted(n for n in joints if any(n in table.joints for _, table in runs)))
    if len(numbers) > 1 and not one_sensor(runs, numbers):
        return combined(
            [diagnose(runs, {n: joints[n]}, scope, relevance=relevance, trust=trust) for n in numbers]
        )
    applied = {n: with_effects_applied(joint) for n, joint in joints.items()}
    findings = _diagnosed(runs, applied, numbers, scope, relevance, trust)
    kept = {n: _without_found(joint, n, findings) for n, joint in applied.items()}
    if all(len(kept[n].effects) == len(joint.effects) for n, joint in applied.items()):
        return findings
    return replace(_diagnosed(runs, kept, numbers, scope, relevance, trust), gaps=findings.gaps)


def _without_found(joint: Joint, number: int, findings: Findings) -> Joint:
    """Return the joint without those of its effects that have the name of a cause."""
    names = {c.name for c in findings.causes if shows_at(c.joint, number)}
    return replace(joint, effects=tuple(e for e in joint.effects if e.name not in names))


def _diagnosed(  # noqa: PLR0917
    runs: Sequence[tuple[str, RunTable]],
    joints: Mapping[int, Joint],
    numbers: tuple[int, ...],
    scope: Scope,
    relevance: float,
    trust: Mapping[str, float],
) -> Findings:
    names = tuple(name for name, _ in runs)
    usable, reasons = usable_signals(runs, joints, numbers, scope.known_references, as_recorded=True)
    few = too_little(usable) if usable else None
    reasons += [few] if few else []
    if not usable or few:
        there = {n: joints[n] for n in numbers}
        seen = [run[0] for run in usable]
        plan = next_experiment([], there, "; ".join(reasons), signals=seen) if there else None
        return Findings(INSUFFICIENT, tuple(reasons), names, numbers, next_experiment=plan)
    judged = tuple(s.number for s in usable[0])
    usable, dataset, outliers = without_outlier_runs(usable, joints, scope)
    if scope.known_references:  # channels are compared as recorded, balances where the torque is known
        kept = [run for run in runs if run[0] in {signals[0].run for signals in usable}]
        usable, _ = usable_signals(kept, joints, judged, scope.known_references)
        dataset = build_dataset(usable, joints, scope)
    noisy = disturbed_signals(runs, joints, numbers, usable, scope)
    dataset = replace(dataset, disturbed=noisy, trust=trust)
    solution = without_events(solve(dataset))
    findings = conclude(solution, names, scope, relevance)
    notes = (*reasons, *(o.text for o in outliers), *resolution_notes(usable), *piece_notes(usable))
    left_out = tuple(f"joint {n}: left out" for n in numbers if n not in judged)
    unjudged = [line for line in reasons if line.startswith(left_out)]
    verdict = findings.verdict
    # no proof for a joint that nobody looked at
    return replace(
        findings,
        verdict=INSUFFICIENT if unjudged and verdict == NO_GAP else verdict,
        reasons=(*unjudged, *findings.reasons, *(scope.note if verdict == UNEXPLAINED else ())),
        channel_notes=notes,
        outlier_runs=tuple(outliers),
        used=tuple(run[0].run for run in usable),
    )


def without_events(solution: Solution) -> Solution:
    """Return the solution again without the events that no effect makes, where there are any: they shall bend none."""
    events = events_left(remaining(solution.dataset, *present_of(solution)))
    return solve(solution.dataset.without_events(events)) if events else solution


def disturbed_signals(
    runs: Sequence[tuple[str, RunTable]],
    joints: Mapping[int, Joint],
    numbers: Sequence[int],
    usable: Sequence[Sequence[JointSignals]],
    scope: Scope = EVERYTHING,
) -> list[list[JointSignals]]:
    """Return the signals of the usable runs with as much noise again on torques and positions as they have."""
    rng = np.random.default_rng(0)
    there, like = {run[0].run for run in usable}, [s for run in usable for s in run]
    noisy = [(name, disturbed(table, joints, rng)) for name, table in runs if name in there]
    again, _ = usable_signals(noisy, joints, numbers, scope.known_references, like)
    used = {s.number for s in usable[0]}
    return [[s for s in run if s.number in used] for run in again if used <= {s.number for s in run}]


def disturbed(table: RunTable, files: Mapping[int, Joint], rng: np.random.Generator) -> RunTable:
    """Return the table with as much white noise again on torques and positions as they have; one sensor has one noise.

    The acceleration's noise is in the response and in the inertia's column, as the torque's is in the load's: were one of
    them alone taken out, a smaller balance would have more evidence.
    """
    known: list[tuple[FloatArray, FloatArray]] = []
    joints = {}
    for n, columns in table.joints.items():
        new = {}
        both = n in files and columns.two_encoders(files[n].gear_ratio)
        own = columns.motor_position_rad is not None and not both  # the link's position is the motor's
        link = () if own else ("link_position_rad",)
        for name in ("torque_nm", "motor_position_rad", "motor_velocity_rad_s", *link):
            x = getattr(columns, name)
            if x is None:
                continue
            noise = next((f * e for y, e in known for f in (1.0, -1.0) if np.array_equal(x, f * y)), None)
            if noise is None:
                noise = rng.normal(size=len(x)) * noise_of(x)
                known.append((x, noise))
            new[name] = x + noise
        if own:
            new["link_position_rad"] = None
        joints[n] = replace(columns, **new)
    return replace(table, joints=joints)


def without_outlier_runs(
    signals: list[list[JointSignals]], joints: Mapping[int, Joint], scope: Scope = EVERYTHING
) -> tuple[list[list[JointSignals]], Dataset, list[OutlierRun]]:
    """Return signals and dataset without the runs that differ from all others, and how those differ: one at a time, fewer
    than half of the recordings.
    """
    outliers: list[OutlierRun] = []
    dataset = build_dataset(signals, joints, scope)
    count = len(set(recordings(signals)))
    while may_leave_out(len(outliers) + 1, count):
        found = outlier_run(dataset)
        if found is None:
            break
        places, one = found
        outliers.append(one)
        signals = [run for r, run in enumerate(signals) if r not in places]
        dataset = build_dataset(signals, joints, scope)
    return signals, dataset, outliers


def one_sensor(runs: Sequence[tuple[str, RunTable]], numbers: Sequence[int]) -> bool:
    """Return whether the joints' torque columns are the same measurement in every run that has them all."""
    for _, table in runs:
        columns = [table.joints[n].torque_nm for n in numbers if n in table.joints]
        there = [c for c in columns if c is not None]
        scale = max(float(np.abs(there[0]).max()), 1e-9) if there else 1.0
        if any(float(np.abs(there[0] - other).max()) > 1e-6 * scale for other in there[1:]):
            return False
    return True


def combined(parts: Sequence[Findings]) -> Findings:
    """Return the findings of several joints as one: the verdict that asks for most, the gain of the largest cause, the next
    experiment of every joint that has one.
    """
    verdict = min((f.verdict for f in parts), key=_WORST_FIRST.index)
    falls = [(f.gain.rmse_before_nm - f.gain.rmse_after_nm, f) for f in parts if f.gain is not None]
    leading = max(falls, key=lambda fall: fall[0], default=(0.0, None))[1]
    plans = {f.joints[0]: f.next_experiment for f in parts if f.joints and f.next_experiment is not None}
    return Findings(
        verdict,
        tuple(f"joint {n}: {reason}" for f in parts for n in f.joints[:1] for reason in f.reasons),
        parts[0].runs,
        tuple(n for f in parts for n in f.joints),
        tuple(sorted((g for f in parts for g in f.gaps), key=lambda g: g.noise_floor_nm**2 - g.rmse_nm**2)),
        tuple(sorted((c for f in parts for c in f.causes), key=lambda c: -c.rms_nm)),
        tuple(sorted((c for f in parts for c in f.candidates), key=lambda c: -c.delta_bic)),
        None if leading is None else leading.gain,
        channel_notes=tuple(dict.fromkeys(note for f in parts for note in f.channel_notes)),
        next_experiment=each_joint(plans) if plans else None,
        traces=tuple(t for f in parts for t in f.traces),
        explained_share=math.nan if leading is None else leading.explained_share,
        unexplained=max(
            (f.unexplained for f in parts if f.unexplained is not None),
            key=lambda left: (left.matters, left.percent_of_rated),
            default=None,
        ),
        outlier_runs=tuple(outliers for f in parts for outliers in f.outlier_runs),
        too_small=tuple(c for f in parts for c in f.too_small),
        cannot_be_told=tuple(u for f in parts for u in f.cannot_be_told),
        predicts=tuple(p for f in parts for p in f.predicts),
        used=tuple(name for name in parts[0].runs if any(name in f.used_runs for f in parts)),
    )
