"""What the extended model gains on runs left out. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from estimator.checked import ConfigError
from estimator.friction import FloatArray
from estimator.parameters import Effect
from sysid.diagnosis.channel import Channel
from sysid.diagnosis.findings import Gain, RunGain
from sysid.diagnosis.free_run import free_run
from sysid.diagnosis.mixed import solve
from sysid.diagnosis.prepared import Prepared
from sysid.diagnosis.refine import Refined

_BOOTSTRAPS: Final = 2000


def held_out_gain(prepared: Prepared, refined: Refined, seed: int = 0) -> Gain:
    """Return the error of the simulation's torque before and after, each run with the parameters of all others.

    In the balance where most goes away; the run's own zero and friction of the day stay in, as in service. ci95: of
    rmse_before - rmse_after [Nm], bootstrap over runs.
    """
    steps = left_out_steps(refined)
    squares: dict[Channel, list[tuple[float, float, int]]] = {}
    for run, left, step in zip(prepared.runs, refined.runs, steps, strict=True):
        for channel, d in left.channels.items():
            before = run.channels[channel].residual[d.valid]
            after = (d.residual - d.regressors @ step[d.index])[d.valid]
            if channel.balance == "torsion" and len(before):
                before, after = before - before.mean(), after - after.mean()
            squares.setdefault(channel, []).append(
                (float(before @ before), float(after @ after), len(before))
            )
    drops = {c: _rms(np.array(s), 0) - _rms(np.array(s), 1) for c, s in squares.items()}
    channel = max(drops, key=lambda c: drops[c])
    table = np.array(squares[channel])
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(table), size=(_BOOTSTRAPS, len(table)))
    sums = table[picks].sum(axis=1)
    drawn = np.sqrt(sums[:, 0] / sums[:, 2]) - np.sqrt(sums[:, 1] / sums[:, 2])
    low, high = np.percentile(drawn, (2.5, 97.5))
    free = _free_runs(prepared, refined, steps)
    return Gain(
        _rms(table, 0),
        _rms(table, 1),
        f"each of {len(table)} runs left out once; {channel.balance} balance of joint {channel.joint}",
        (float(low), float(high)),
        *free,
        tuple(
            RunGain(run.name, _rms(row, 0), _rms(row, 1))
            for run, row in zip(prepared.runs, table[:, None, :], strict=True)
            if row[0, 2] > 0.0
        ),
    )


def _free_runs(prepared: Prepared, refined: Refined, steps: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the rms error of the simulation running free, before and after [rad/s, joint side], over all joints and runs;
    each run with the parameters of all others.
    """
    squares = np.zeros(2)
    count = 0
    for run, step in zip(prepared.signals, steps, strict=True):
        place, causes = 0, []
        for p in refined.present:
            causes.append(p.moved([float(x) for x in step[place : place + len(p.free)]]))
            place += len(p.free)
        for s in run:
            mine = [p for p in causes if p.joint in ("sensor", s.number)]
            if not mine:
                continue
            effects = [*s.joint.effects, *(Effect(p.effect.name, dict(p.values)) for p in mine)]
            try:
                after = free_run(s, replace(s.joint, effects=tuple(effects))).rmse_rad_s
            except ConfigError:
                continue  # a run left out can take a parameter out of its range
            before = free_run(s, s.joint).rmse_rad_s
            squares += (before**2, after**2)
            count += 1
    if not count:
        return float("nan"), float("nan")
    root = np.sqrt(squares / count)
    return float(root[0]), float(root[1])


def _rms(table: FloatArray, column: int) -> float:
    return float(np.sqrt(table[:, column].sum() / max(table[:, 2].sum(), 1.0)))


def left_out_steps(refined: Refined) -> list[FloatArray]:
    """Return per run the change of the free parameters when this run is left out."""
    marginals, _ = refined.mixed.marginal_runs(refined.variances)
    total = marginals.sum(axis=0)
    k = refined.mixed.columns
    return [solve(total - m, k)[0] for m in marginals]
