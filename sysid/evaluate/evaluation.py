"""The whole evaluation: samples of every run and joint, then every table of the report. No file, no clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, TypeVar

import numpy as np

from estimator.fused_network import FusedNetwork
from estimator.fused_trust import Envelope
from sysid.evaluate.constant import PlateauScore, is_constant, plateau_scores, plateaus_of
from sysid.evaluate.crossings import Jump, largest_jump
from sysid.evaluate.inputs import JudgedRun
from sysid.evaluate.intervals import IntervalTables, Standstill, interval_tables, standstill
from sysid.evaluate.loop_time import LoopTime
from sysid.evaluate.methods import OURS, TITLES, JointModels
from sysid.evaluate.outside import Outside, outside_scores
from sysid.evaluate.samples import Samples, take_samples
from sysid.evaluate.targets import Target, targets
from sysid.evaluate.variable import ErrorTables, error_tables, median_run
from sysid.findings import Finding
from sysid.plateaus import Plateau

SILENT_SHARE: Final = 0.01
"""Share of the moving samples that a method may leave without a value and not be named for it."""

T = TypeVar("T")
Progress = Callable[[Sequence[T], str], Iterable[T]]


class RunRecord(NamedTuple):
    """What a run was: kind constant, variable or outside; joints: by number, (share scored, share standing)."""

    name: str
    sha256: str
    kind: str
    duration_s: float
    velocity_joint: int | None
    velocity_joint_by: str
    joints: Mapping[int, tuple[float, float]]


@dataclass(frozen=True)
class Evaluation:
    """Every table of the report.

    plateaus: of runs at constant velocity; variable, constant_tables: errors over the samples of runs of either kind;
    intervals: of ours, under "variable", "constant" and "all"; jumps, passages: largest ones by method; picture: the run
    of the figure like the paper's Fig. 16; loop_time: what steps cost, None where it was not measured.
    """

    models: tuple[JointModels, ...]
    runs: tuple[RunRecord, ...]
    findings: tuple[Finding, ...]
    plateaus: tuple[PlateauScore, ...]
    variable: ErrorTables
    constant_tables: ErrorTables
    intervals: Mapping[str, IntervalTables]
    standstill: Mapping[int, Standstill]
    jumps: Mapping[str, Jump]
    passages: Mapping[str, Jump]
    outside: tuple[Outside, ...]
    picture: Samples | None
    loop_time: LoopTime | None = None
    targets: tuple[Target, ...] = field(default=())

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that at least one joint has, in TITLES' order."""
        return tuple(method for method in TITLES if any(method in each.methods for each in self.models))


class _Judged(NamedTuple):
    run: JudgedRun
    samples: tuple[Samples, ...]
    plateaus: tuple[tuple[Plateau, ...], ...]
    """Of each of `samples`."""


def evaluate(
    runs: Sequence[JudgedRun],
    outside: Sequence[JudgedRun],
    models: Sequence[JointModels],
    progress: Progress[JudgedRun] = lambda items, text: items,
    measured: LoopTime | None = None,
) -> Evaluation:
    """Judge all methods on runs, and ours outside its envelope on the runs `outside`; measured: what their steps cost.

    Raises ConfigError when a joint and its networks do not fit, ValueError when no run has a sample to score.
    """
    findings: list[Finding] = []
    judged = _judge(progress(runs, "estimating"), models, findings)
    beyond = _judge(progress(outside, "estimating outside"), models, findings)
    if not judged:
        raise ValueError(
            "found no run with a moving sample that every method has a value for: nothing to judge"
        )
    constant: list[_Judged] = []
    variable: list[_Judged] = []
    for each in judged:
        (constant if any(map(is_constant, each.plateaus, each.samples)) else variable).append(each)
    scored: list[PlateauScore] = []
    for each in constant:
        for plateaus, samples in zip(each.plateaus, each.samples, strict=True):
            found, lost = plateau_scores(plateaus, samples)
            scored += found
            findings += [Finding("plateau_lost", text) for text in lost]
    every = _samples(judged)
    parts = {"variable": _samples(variable), "constant": _samples(constant), "all": every}
    modes = {each.run.name: each.run.velocity_joint for each in judged}
    methods = [method for method in TITLES if any(method in each.methods for each in models)]
    result = Evaluation(
        models=tuple(models),
        runs=tuple(
            _record(each, kind)
            for kind, part in (("constant", constant), ("variable", variable), ("outside", beyond))
            for each in part
        ),
        findings=tuple(findings),
        plateaus=tuple(scored),
        variable=error_tables(parts["variable"], modes),
        constant_tables=error_tables(parts["constant"], modes),
        intervals={
            name: table for name, part in parts.items() if (table := interval_tables(part)) is not None
        },
        standstill=standstill(every),
        jumps={method: jump for method in methods if (jump := largest_jump(every, method)) is not None},
        passages={
            method: jump
            for method in methods
            if (jump := largest_jump(every, method, passage=True)) is not None
        },
        outside=tuple(outside_scores(_samples(beyond), _envelopes(models))),
        picture=_picture(parts["variable"], modes),
        loop_time=measured,
    )
    return replace(result, targets=targets(result))


def _judge(
    runs: Iterable[JudgedRun], models: Sequence[JointModels], findings: list[Finding]
) -> list[_Judged]:
    judged = []
    for run in runs:
        samples, plateaus = [], []
        for each in models:
            if each.number not in run.columns:
                continue
            columns = run.columns[each.number]
            one = take_samples(run.name, each, run.table.time_s, columns)
            if not one.scored.any():
                findings.append(
                    Finding("nothing_to_score", f"{run.name}: j{each.number}: {_why_nothing(one)}")
                )
                continue
            findings += _silent(one)
            samples.append(one)
            plateaus.append(tuple(plateaus_of(run.name, run.table.time_s, columns, each.joint)))
        if samples:
            judged.append(_Judged(run, tuple(samples), tuple(plateaus)))
    return judged


def _silent(samples: Samples) -> list[Finding]:
    """Name methods that had no value where the joint moved: what they miss is in no score."""
    moving = samples.scored | samples.missing
    share = float(np.count_nonzero(samples.missing)) / float(np.count_nonzero(moving))
    if share <= SILENT_SHARE:
        return []
    silent = [
        TITLES[method]
        for method, value in samples.estimate_nm.items()
        if np.isnan(value[samples.missing]).mean() > SILENT_SHARE
    ]
    return [
        Finding(
            "no_value",
            f"{samples.run}: j{samples.number}: found no value of {', '.join(silent)} in {100.0 * share:.1f} % of the "
            "moving samples: these are scored for no method",
        )
    ]


def _why_nothing(samples: Samples) -> str:
    if samples.standing.any():
        share = 100.0 * float(samples.standing.mean())
        return f"found it standing in {share:.0f} % of the samples and never moving with a value of every method: not judged"
    return "found no sample at which every method has a value, expected most of them: not judged"


def _samples(judged: Iterable[_Judged]) -> list[Samples]:
    return [samples for each in judged for samples in each.samples]


def _envelopes(models: Iterable[JointModels]) -> dict[int, Envelope]:
    networks = {each.number: each.networks.get(OURS) for each in models}
    return {
        number: network.envelope for number, network in networks.items() if isinstance(network, FusedNetwork)
    }


def _picture(samples: Sequence[Samples], modes: Mapping[str, int | None]) -> Samples | None:
    """The median run, of the joint in velocity mode where that is known, as in the paper's Fig. 16."""
    tested = [each for each in samples if modes.get(each.run) == each.number]
    return median_run(tested or samples)


def _record(judged: _Judged, kind: str) -> RunRecord:
    run = judged.run
    joints = {
        each.number: (float(each.scored.mean()), float(each.standing.mean())) for each in judged.samples
    }
    duration = float(run.table.time_s[-1] - run.table.time_s[0])
    return RunRecord(run.name, run.sha256, kind, duration, run.velocity_joint, run.by, joints)
