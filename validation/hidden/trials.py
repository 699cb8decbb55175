"""One seed of the campaign: the same bench with nothing hidden, one effect, two, and something no library has.

The diagnosis gets the run tables and the nominal joint files; sizes come from the minimum detectable sizes it reports
for the same motions with nothing hidden.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.sysid.diagnosis.base_loss import BaseLoss
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import CandidateEvidence, Findings
from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned, contribution
from jtqd.sysid.diagnosis.signals import joint_signals
from jtqd.sysid.planner.plan import Plan, check_plan
from validation.hidden.case import Case, draw_many, follow_up
from validation.hidden.menu import MENU, SENSOR, base_value, scaled
from validation.hidden.order import Hidden, Order
from validation.hidden.profiles import Reference
from validation.hidden.scores import Outcome, score
from validation.hidden.unknown import UNKNOWN
from validation.worlds.judge import judged
from validation.worlds.recorder import Recorder

KINDS: Final = ("nothing", "one", "least", "two", "unknown")
FACTOR: Final = 3.0
UNLIKE: Final = tuple(name for name, entry in UNKNOWN.items() if not entry.resembling)
_WHERE: Final = re.compile(r"(motor|torsion) balance of joint (\d)")


def trial(
    number: int, seed: int, kinds: Sequence[str] = KINDS, recorder: Recorder | None = None
) -> list[Outcome]:
    """Return the outcomes of trial `number` of a campaign; every effect and every unknown thing has its turn by number.

    recorder: what is diagnosed are the files that it writes; the sizes are those for the runs as they are.
    """
    own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    rng = np.random.default_rng([own, 77])
    plain = draw_many([Order(own)])[0]
    findings = diagnose(tables(plain.runs), joint_files(plain))
    seen = findings if recorder is None else judged(plain.runs, plain.joints, recorder, own)
    allowed = recorder.explains if recorder is not None else ()
    out = [score("nothing", own, plain.truth, seen, not_wrong=allowed)]
    orders = orders_of(number, own, rng, plain, findings, kinds, out)
    cases = draw_many([order for _, order in orders]) if orders else []
    for (kind, order), case in zip(orders, cases, strict=True):
        if recorder is not None:
            recorded = judged(case.runs, case.joints, recorder, own)
            detail = [_short(t) for t in case.truth]
            out.append(score(kind, own, case.truth, recorded, not_wrong=allowed, detail=detail))
            continue
        found = diagnose(tables(case.runs), joint_files(case))
        more: dict[str, Any] = {"detail": [_short(t) for t in case.truth]}
        if kind in ("one", "two"):
            more["gain"] = gains(case, found)
        if kind == "one" and found.verdict == "ambiguous" and found.next_experiment is not None:
            more["settled"] = settled(order, case, found)
        out.append(score(kind, own, case.truth, found, **more))
    return out


def _short(truth: Mapping[str, Any]) -> str:
    """Return what was hidden as text, with the first of its right places."""
    values = " ".join(f"{k}={x:.3g}" for k, x in truth["parameters"].items())
    right = [
        " ".join(str(round(x, 3) if isinstance(x, float) else x) for x in p.values())
        for p in truth.get("places", ())
    ]
    text = f"{truth['name']} of {truth['joint']} size {truth['size']:.3g} ({values})"
    return text + (f"; right: {'; '.join(right[:4])}" if right else "")


def orders_of(  # noqa: PLR0917
    number: int,
    own: int,
    rng: np.random.Generator,
    plain: Case,
    findings: Findings,
    kinds: Sequence[str],
    out: list[Outcome],
) -> list[tuple[str, Order]]:
    """Return (kind, what to draw) for one trial; effects that these motions cannot show are noted as invisible in `out`."""
    names = list(MENU)
    orders: list[tuple[str, Order]] = []
    name = names[number % len(names)]
    here = [k for k in ("one", "least") if k in kinds]
    if here:
        chosen = _pick(name, rng, plain, findings)
        for kind in here:
            if chosen is None:
                out.append(Outcome(kind, own, ((name, None),), "invisible"))
            else:
                orders.append(
                    (kind, Order(own, [_sized(*chosen, FACTOR if kind == "one" else 1.0, rng, plain)]))
                )
    if "two" in kinds:
        pair: list[Hidden] = []
        for other in rng.permutation(names):
            found = _pick(str(other), rng, plain, findings)
            if found is not None:
                pair.append(_sized(*found, FACTOR, rng, plain))
            if len(pair) == 2:
                break
        orders.append(("two", Order(own, pair)))
    if "unknown" in kinds:
        strange = UNLIKE[number % len(UNLIKE)]
        orders.append(("unknown", Order(own, [Hidden(strange, int(rng.integers(1, 3)))])))
    return orders


def _pick(
    name: str, rng: np.random.Generator, plain: Case, findings: Findings
) -> tuple[CandidateEvidence, Mapping[str, float]] | None:
    """Return an evidence of this effect and its parameters at the minimum, one of the visible ones at random."""
    options = [
        (row, values) for row in findings.candidates if row.name == name for values in minima(row, plain)
    ]
    return options[int(rng.integers(len(options)))] if options else None


def minima(row: CandidateEvidence, plain: Case) -> list[Mapping[str, float]]:
    """Return the parameters at the minimum detectable size, one entry per way of looking, absolute as in a joint file."""
    complete = getattr(row, "at_minimum", ())
    if complete:
        return [dict(values) for values in complete if _plausible(row.name, values)]
    nominal = plain.joints[row.joint if isinstance(row.joint, int) else 1]
    entry = MENU[row.name]
    out: list[Mapping[str, float]] = []
    for parameter, value in row.minimum.items():
        if parameter in (entry.leading, entry.second) and 0.0 < value.value < np.inf:
            values = {parameter: base_value(row.name, nominal, parameter) + value.value}
            if row.name == "channel_delay":
                values["channel"] = 0.0 if row.joint == SENSOR else 1.0
            out.append(values)
    return out


def _plausible(name: str, values: Mapping[str, float]) -> bool:
    """Return whether the parameters are within the ranges of the library at three times the size."""
    ranges = {p.name: p for p in EFFECTS[name].parameters}
    entry = MENU[name]
    for key in (entry.leading, entry.second):
        if key in values and not entry.key and key != "stiffness_nm_per_rad":
            away = entry.neutral if key == entry.leading else 0.0
            if abs(FACTOR * (values[key] - away)) > max(abs(ranges[key].low), abs(ranges[key].high)):
                return False
    return True


def _sized(
    row: CandidateEvidence, minimum: Mapping[str, float], factor: float, rng: np.random.Generator, plain: Case
) -> Hidden:
    nominal = plain.joints[row.joint if isinstance(row.joint, int) else 1]
    joint = row.joint if isinstance(row.joint, int) else SENSOR
    return Hidden(row.name, joint, scaled(row.name, nominal, minimum, factor, rng))


def tables(runs: Sequence[Mapping[str, Any]], first: int = 1) -> list[tuple[str, RunTable]]:
    """Return the columns as (name, RunTable), named run<first>, ..."""
    return [
        (
            f"run{first + k}",
            RunTable(
                c["time_s"],
                {n: JointColumns(**{x: c.get(f"j{n}.{x}") for x in COLUMN_NAMES}) for n in (1, 2)},
            ),
        )
        for k, c in enumerate(runs)
    ]


def joint_files(case: Case, hidden: bool = False) -> dict[int, Joint]:
    """Return the nominal joints; hidden: with the effects that are there as effects of the file."""
    out = {}
    for n, mapping in case.joints.items():
        full: dict[str, Any] = dict(mapping)
        if hidden:
            full["effects"] = [
                {"name": t["name"], "parameters": t["parameters"]}
                for t in case.truth
                if t["joint"] in (n, SENSOR)
            ]
        out[n] = Joint.from_mapping(full, f"joint{n}")
    return out


def gains(case: Case, findings: Findings) -> tuple[float, float, float] | None:
    """Return rms before, after, and after with the true model, in the balance that the findings' gain is measured in."""
    gain = findings.gain
    where = _WHERE.search(gain.split) if gain is not None else None
    if gain is None or where is None:
        return None
    return gain.rmse_before_nm, gain.rmse_after_nm, _true_rms(case, where[1], int(where[2]))


def _true_rms(case: Case, balance: str, number: int) -> float:
    """Return the rms that the true model leaves: the run's own zero and friction of the day stay in, as in the gain."""
    joint = joint_files(case, hidden=True)[number]
    base = BaseLoss(joint)
    square, count = 0.0, 0
    for name, table in tables(case.runs):
        s = joint_signals(name, table, number, joint, base)
        residual = s.motor_nm if balance == "motor" else s.torsion_nm
        assert residual is not None
        for effect in joint.effects:
            there = contribution(EFFECTS[effect.name], effect.parameters, s)
            residual = residual - there.get(balance, 0.0)
        samples = bin_samples([s])
        left = binned(residual, samples)
        left = left[all_in_bin(s.moving, samples)] if balance == "motor" else left - left.mean()
        square += float(left @ left)
        count += len(left)
    return float(np.sqrt(square / max(count, 1)))


def settled(order: Order, case: Case, findings: Findings) -> bool:
    """Return whether the plan of the findings, run on the same bench, makes the hidden effect the only name."""
    assert findings.next_experiment is not None
    plan = Plan.from_mapping(findings.next_experiment["plan"], "next_experiment")
    references = [
        Reference(s.velocity_joint - 1, s.velocity_rad_s, s.current_a, s.off)
        for s in check_plan(plan).values()
    ]
    runs = [*case.runs, *follow_up(order, references)]
    later = diagnose(tables(runs), joint_files(case))
    return all(score("", 0, case.truth, later).named)
