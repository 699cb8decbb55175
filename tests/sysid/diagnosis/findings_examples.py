"""Findings made up for tests of the report: every verdict.

Their signals follow from their causes (a ripple of the stated size is in the residual), their evidence is invented.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from jtqd.sysid.diagnosis.findings import (
    Cause,
    Findings,
    Gain,
    OutlierRun,
    Provenance,
    RunGain,
    UnexplainedResidual,
    Untold,
)
from tests.sysid.diagnosis.findings_parts import (
    GAIN,
    INFINITY,
    NAN,
    NOTHING,
    RIPPLE,
    SLIP,
    VISCOUS,
    candidates,
    gap,
    given,
    trace,
    value,
)


def _runs(count: int) -> tuple[str, ...]:
    return tuple(f"excitation_{k:02d}.csv.gz" for k in range(1, count + 1))


def _held(count: int, before: float, after: float) -> tuple[RunGain, ...]:
    """Held-out errors; the third run is the worst."""
    return tuple(RunGain(run, before, after * (1.2 if k == 2 else 0.9)) for k, run in enumerate(_runs(count)))


def one_cause() -> Findings:
    """Torque ripple in joint 1, one joint recorded."""
    ripple = {
        "amplitude_nm": value(0.418, 0.021, "Nm"),
        "order_per_motor_rev": given(2.0, "1/rev"),
        "phase_rad": value(0.71, 0.05, "rad"),
    }
    return Findings(
        verdict="cause",
        provenance=Provenance("2026-11-26", "0.2.0", "jtq diagnose runs --out d", {"joint1.yaml": "ab" * 32}),
        reasons=("the gap is 2.3 times the noise floor of 3 repeated runs",),
        runs=_runs(6),
        joints=(1,),
        gaps=(
            gap(
                1,
                "motor",
                0.343,
                0.149,
                {"motor_angle": {1: 0.21, 9: 0.22, 5: 0.2, 13: 0.19}, "frequency": {6: 0.5}},
            ),
            gap(1, "torsion", 0.152, 0.149, {}),
        ),
        causes=(Cause("torque_ripple", 1, ripple, 4312.0, 0.296, "motor", 0.94),),
        too_small=(
            Cause(
                *("current_offset", 1, {"offset_a": value(0.0123, 0.001, "A")}),
                *(40.0, 0.03, "motor", 0.01),
            ),
        ),
        cannot_be_told=(
            Untold("gear_damping", 1, "these runs have no variation that shows it", "quick_changes"),
            Untold("sensor_drift", "sensor", "cannot be told from these runs", "warm_up"),
        ),
        explained_share=0.94,
        unexplained=UnexplainedResidual(1, "motor", 0.072, 0.18, 0.06, 0.2, matters=False),
        outlier_runs=(
            OutlierRun(
                "excitation_07.csv.gz",
                "gain",
                "current_a",
                1,
                0.071,
                0.002,
                "",
                ("gain of torque_nm of the sensor",),
            ),
        ),
        candidates=candidates(
            (1,),
            {
                ("torque_ripple", 1): (4312.0, "in the set, certain"),
                ("cogging", 1): (212.0, "no evidence beyond the set"),
                ("kinematic_error", 1): (94.0, "no evidence beyond the set"),
            },
        ),
        gain=Gain(
            0.343, 0.151, "6 runs, each left out once", (0.185, 0.198), _held(6, 0.343, 0.151), 1, "motor"
        ),
        traces=tuple(
            trace(run, 1, balance, RIPPLE if balance == "motor" else NOTHING, seed=k)
            for k, run in enumerate(_runs(6))
            for balance in ("motor", "torsion")
        ),
    )


def two_causes() -> Findings:
    """Viscous friction for certain, and one of two that cannot be distinguished, with the experiment that would."""
    limits = {
        "current_a": 4.0,
        "velocity_rad_s": 2.0,
        "torque_nm": 40.0,
        "travel_rad": 30.0,
        "temperature_c": 70.0,
    }
    held = {"kind": "plateau", "current_a": 2.0, "hold_s": 2.0, "ramp_s": 0.3}

    def reversals(k: int) -> dict[str, object]:
        segments = [{**held, "velocity_rad_s": s * 0.4 * k} for s in (1, -1)] * 8
        return {"name": f"reversals_{k}", "velocity_joint": 1, "segments": segments}

    plan = {
        "schema": "jtq.plan/1",
        "name": "separate-link-inertia-from-delay",
        "limits": limits,
        "runs": [reversals(k) for k in (1, 2, 3, 4)],
    }
    viscous = {"viscous_nms_per_rad": value(5.72, 0.14, "Nms/rad")}
    inertia = {"link_inertia_kgm2": value(0.213, 0.048, "kgm2")}
    base = one_cause()
    return replace(
        base,
        verdict="ambiguous",
        reasons=(
            "the gap is 4.5 times the noise floor",
            "link_inertia and channel_delay leave the same trace where acceleration and velocity keep one ratio",
        ),
        joints=(1, 2),
        gaps=(
            gap(1, "motor", 0.912, 0.204, {"velocity": {0: 0.33, 11: 0.31}}),
            gap(1, "torsion", 0.31, 0.21, {"frequency": {7: 0.4}}),
            gap(2, "motor", 0.207, 0.204, {}),
            gap(2, "torsion", 0.211, 0.21, {}),
        ),
        causes=(
            Cause("viscous_friction", 1, viscous, 8210.0, 0.81, "motor", 0.91),
            Cause(
                *("link_inertia", 1, inertia, 4.0, 0.22, "torsion", 0.08),
                grade="one_of",
                rivals=("channel_delay",),
            ),
        ),
        candidates=candidates(
            (1, 2),
            {
                ("viscous_friction", 1): (8210.0, "in the set, certain"),
                ("link_inertia", 1): (133.0, "in the set, certain"),
                ("channel_delay", 1): (129.4, "no evidence beyond the set"),
                ("torque_constant", 1): (1204.0, "no evidence beyond the set"),
            },
        ),
        gain=Gain(0.912, 0.238, "6 runs, each left out once", (0.629, 0.711)),
        next_experiment={
            "why": "Link inertia grows with acceleration at any speed, a delay with the rate of the torque. Reversals at "
            "four speeds with equal ramps change one and not the other.",
            "plan": plan,
        },
        traces=tuple(
            trace(run, j, balance, VISCOUS if (j, balance) == (1, "motor") else NOTHING, seed=10 * j + k)
            for k, run in enumerate(_runs(6))
            for j in (1, 2)
            for balance in ("motor", "torsion")
        ),
    )


def no_gap() -> Findings:
    return Findings(
        verdict="no_gap",
        reasons=("no effect of the library and no map stands out of the noise",),
        runs=_runs(6),
        joints=(1, 2),
        too_small=one_cause().too_small,
        unexplained=UnexplainedResidual(1, "motor", 0.0, 0.0, 0.0, 0.2, matters=False),
        gaps=tuple(gap(j, b, 0.154 + 0.001 * j, 0.153, {}) for j in (1, 2) for b in ("motor", "torsion")),
        candidates=candidates((1, 2), {}),
        traces=tuple(trace(run, 1, "motor", NOTHING, seed=k) for k, run in enumerate(_runs(2))),
    )


def unexplained() -> Findings:
    """A coupling that slips at one place of the link's turn."""
    return Findings(
        verdict="unexplained",
        reasons=(
            "the best effect (stribeck_friction) takes 4 % of the gap on held-out runs",
            "the residual is above noise in 2 of 16 bins of the link angle, block permutation p < 0.001",
        ),
        runs=_runs(4),
        joints=(1,),
        gaps=(gap(1, "motor", 0.61, 0.2, {"link_angle": {3: 0.52, 4: 0.21}, "velocity": {6: 0.2}}),),
        candidates=candidates((1,), {("stribeck_friction", 1): (38.0, "no evidence beyond the set")}),
        unexplained=UnexplainedResidual(1, "motor", 0.58, 1.45, 1.0, 0.2, matters=True),
        channel_notes=("excitation_03.csv.gz: j1.temperature_c is constant (25.0): not used",),
        traces=tuple(trace(run, 1, "motor", SLIP, seed=k) for k, run in enumerate(_runs(4))),
    )


def insufficient() -> Findings:
    plan = two_causes().next_experiment
    assert plan is not None
    return Findings(
        verdict="insufficient_data",
        reasons=(
            "1 run of 4.2 s: at least 2 runs are needed to tell a cause from a change between runs",
            "velocity never exceeds 0.03 rad/s: friction has no direction there",
        ),
        runs=("test.csv",),
        joints=(1,),
        candidates=tuple(
            replace(
                c,
                delta_bic=NAN,
                reason="cannot be told from these runs",
                minimum={k: replace(v, value=INFINITY) for k, v in c.minimum.items()},
            )
            for c in candidates((1,), {})
        ),
        channel_notes=(
            "test.csv: j1.torque_nm looks like mNm (median 12400): divide by 1000 (--columns)",
            "test.csv: 12 gaps in time, longest 0.31 s",
        ),
        next_experiment={
            "why": "Speeds from 0.05 to 1.5 rad/s in both directions, with and without load, make friction, gains "
            "and offsets visible.",
            "plan": plan["plan"],
        },
    )


def sensor() -> Findings:
    return replace(
        two_causes(),
        verdict="cause",
        reasons=("the residuals of both joints agree: common to both is the sensor's part",),
        gaps=tuple(
            gap(j, b, 0.82, 0.21, {"load": {0: 0.3, 11: 0.31}}) for j in (1, 2) for b in ("motor", "torsion")
        ),
        causes=(
            Cause(
                "sensor_gain",
                "sensor",
                {"gain": value(1.0481, 0.0017, "1")},
                5120.0,
                0.79,
                "motor",
                0.97,
            ),
        ),
        candidates=candidates(
            (1, 2),
            {
                ("sensor_gain", "sensor"): (5120.0, "in the set, certain"),
                ("torque_constant", 1): (2230.0, "no evidence beyond the set"),
                ("torque_constant", 2): (2190.0, "no evidence beyond the set"),
            },
        ),
        gain=Gain(0.82, 0.214, "6 runs, each left out once", (0.582, 0.623)),
        next_experiment=None,
        traces=tuple(trace(run, j, "motor", GAIN, seed=k) for k, run in enumerate(_runs(6)) for j in (1, 2)),
    )


EXAMPLES: Mapping[str, Callable[[], Findings]] = {
    "one_cause": one_cause,
    "two_causes": two_causes,
    "no_gap": no_gap,
    "unexplained": unexplained,
    "insufficient": insufficient,
    "sensor": sensor,
}
