"""The evaluation as plain values, schema jtq.evaluation/1: what is written, and all that the reports show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

from sysid.evaluate import constant
from sysid.evaluate.constant import PlateauScore, speed_groups
from sysid.evaluate.evaluation import Evaluation, RunRecord
from sysid.evaluate.intervals import IntervalTables
from sysid.evaluate.methods import OURS, PAPERS, TITLES, JointModels
from sysid.evaluate.score import ratio
from sysid.evaluate.targets import mse, worse_runs
from sysid.evaluate.variable import PAPER_MSE_NM2, ErrorTables, Row

SCHEMA: Final = "jtq.evaluation/1"


def as_mapping(result: Evaluation) -> dict[str, Any]:
    """Return dicts, lists, texts and finite numbers, None where there is none; joints are keys as text."""
    mapping = {
        "schema": SCHEMA,
        "methods": {method: TITLES[method] for method in result.methods},
        "models": [_models(each) for each in result.models],
        "runs": [_run(each, result) for each in result.runs],
        "findings": [item._asdict() for item in result.findings],
        "figures_to_reach": [each._asdict() for each in result.targets],
        "constant": _constant(result),
        "variable": _tables(result.variable) | _against_paper(result.variable),
        "constant_runs": _tables(result.constant_tables),
        "worse_than_physics": [
            {"run": run, "number": number, "ours_mse_nm2": ours, "physics_mse_nm2": physics}
            for run, number, ours, physics in worse_runs(
                {**result.variable.runs, **result.constant_tables.runs}
            )
        ],
        "intervals": {name: _intervals(each) for name, each in result.intervals.items()},
        "standstill": {number: vars(each) for number, each in result.standstill.items()},
        "jumps": {"at": result.jumps, "passage": result.passages},
        "outside": list(result.outside),
        "loop_time": result.loop_time,
        "picture": None
        if result.picture is None
        else {"run": result.picture.run, "number": result.picture.number},
    }
    plain: dict[str, Any] = _plain(mapping)
    return plain


def _models(each: JointModels) -> dict[str, Any]:
    return {
        "number": each.number,
        "joint": each.joint.name,
        "rated_torque_nm": each.joint.rated_torque_nm,
        "methods": each.methods,
        "missing": each.missing,
        "files": each.files,
        "training_runs": len(each.training.sources),
        "silent_about_training": each.training.silent,
    }


def _run(record: RunRecord, result: Evaluation) -> dict[str, Any]:
    tables = {"variable": result.variable, "constant": result.constant_tables}.get(record.kind)
    joints = {
        number: {
            "scored": scored,
            "standing": standing,
            "errors": None if tables is None else _row(tables.runs[record.name, number]),
        }
        for number, (scored, standing) in record.joints.items()
    }
    return record._asdict() | {"joints": joints}


def _constant(result: Evaluation) -> dict[str, Any]:
    numbers = sorted({each.number for each in result.plateaus})
    own = {number: [each for each in result.plateaus if each.number == number] for number in numbers}
    hard = constant.hardest(result.plateaus)
    return {
        "plateaus": [_plateau(each) for each in result.plateaus],
        "speeds": [
            {"number": number, "drive": drive, "velocity_rad_s": speed, **_group(group, result.methods)}
            for number in numbers
            for (drive, speed), group in speed_groups(own[number]).items()
        ],
        "hardest": {
            "paper_percent": constant.PAPER_WORST_PERCENT,
            "velocity_rad_s": constant.WORST_VELOCITY_RAD_S,
            "torque_nm": constant.WORST_TORQUE_NM,
            "joints": {
                number: _group([each for each in hard if each.number == number], result.methods)
                for number in numbers
            },
        },
    }


def _group(group: list[PlateauScore], methods: Iterable[str]) -> dict[str, Any]:
    torques = [abs(each.torque_nm) for each in group]
    worst: dict[str, dict[str, Any]] = {"worst_percent": {}, "worst_rated_percent": {}}
    for method in methods:
        for key, size in (
            ("worst_percent", PlateauScore.percent),
            ("worst_rated_percent", PlateauScore.rated_percent),
        ):
            found = constant.worst(group, method, size)
            worst[key][method] = None if found is None else found[0]
    return {
        "plateaus": len(group),
        "least_torque_nm": min(torques, default=None),
        "most_torque_nm": max(torques, default=None),
        **worst,
    }


def _plateau(each: PlateauScore) -> dict[str, Any]:
    return each._asdict() | {
        "percent": {method: each.percent(method) for method in each.errors_nm},
        "rated_percent": {method: each.rated_percent(method) for method in each.errors_nm},
    }


def _tables(tables: ErrorTables) -> dict[str, Any]:
    return {
        "tested": _row(tables.tested),
        "both": _row(tables.both),
        "joints": {number: _row(one) for number, one in tables.joints.items()},
        "quadrants": {
            n: {name: _row(one) for name, one in rows.items()} for n, rows in tables.quadrants.items()
        },
        "velocities": {
            n: {name: _row(one) for name, one in rows.items()} for n, rows in tables.velocities.items()
        },
        "bare_network_mse_nm2": {"tested": tables.bare_tested_nm2, "both": tables.bare_both_nm2},
    }


def _against_paper(tables: ErrorTables) -> dict[str, Any]:
    return {
        "paper_mse_nm2": PAPER_MSE_NM2,
        "ratios": {
            name: {
                "tob_to_paper": ratio(mse(one, "tob"), mse(one, PAPERS)),
                "efficiency_to_paper": ratio(mse(one, "efficiency"), mse(one, PAPERS)),
                "ours_to_paper": ratio(mse(one, OURS), mse(one, PAPERS)),
                "ours_to_physics": ratio(mse(one, OURS), mse(one, "physics")),
            }
            for name, one in (("tested", tables.tested), ("both", tables.both))
        },
    }


def _row(one: Row) -> dict[str, Any]:
    return {method: value._asdict() for method, value in one.items()}


def _intervals(table: IntervalTables) -> dict[str, Any]:
    return {
        "method": table.method,
        "overall": table.overall,
        "joints": table.joints,
        "quadrants": table.quadrants,
        "curve": {"both" if number is None else number: one for number, one in table.curve.items()},
    }


def _plain(value: Any) -> Any:
    """Named tuples and mappings as dicts with text keys, sequences as lists, numbers that are not finite as None."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
