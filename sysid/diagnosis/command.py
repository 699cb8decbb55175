"""`jtq diagnose`: what the simulation gets wrong on measured runs, by name; findings, report, extended joint file."""

from __future__ import annotations

import argparse
import datetime as dt
import hashlib
import json
import math
import re
import shlex
import sys
import tempfile
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from jtqd import __version__
from jtqd.estimator.command_line import check_installed, command_parser, make_directory
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.run import RunTableError
from jtqd.sysid.diagnosis.findings import (
    NO_GAP,
    SENSOR,
    Cause,
    Findings,
    JointName,
    Provenance,
    Scope,
    shows_at,
    to_mapping,
)
from jtqd.sysid.diagnosis.limits import PRIORS, RELEVANCE
from jtqd.sysid.diagnosis.run_files import findings_of, usable
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.planner.campaigns import beyond_file, parsed_limits, with_limits
from jtqd.sysid.planner.plan import Plan
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.options import (
    UsageError,
    add_columns,
    add_runs,
    check_joint_files,
    joint_files,
    joints_of,
    named_joints,
)
from jtqd.sysid.runs.run_file import RunError, RunFile

BY: Final = "jtq diagnose"
_NEEDED: Final = ("matplotlib", "jinja2", "scipy")
FINDINGS: Final = "findings.json"
REPORT: Final = "report.html"
EXTENDED: Final = "extended.joint.yaml"
_DIGITS: Final = 7
"""Significant digits of a written value; no interval is a millionth of it."""
_OWN: Final = (FINDINGS, REPORT, "extended.joint*.yaml", "next_experiment.*")
"""All names that a diagnosis may write."""
_ITEM: Final = re.compile(r"(?:(?P<where>[1-7]|sensor)=)?(?P<name>[a-z_]+)")
_SIZE: Final = re.compile(r"((?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?) *(%|[a-zµ]+)", re.IGNORECASE)
"""A size with its unit: "1 %", "3 ms"."""


def main(argv: list[str]) -> int:
    """Diagnose and write; exit status 0 no gap, 3 any other verdict, 1 failure, 2 usage."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of NumPy, not for a user
        return _main(argv)


def _main(argv: list[str]) -> int:
    options = parser().parse_args(argv)
    try:
        columns = None if options.columns is None else ColumnMap.load(options.columns)
        files = joint_files(options.joint, columns)
        check_installed("analysis", *_NEEDED)
        check_joint_files(files)
        _check_out(options.out, options.force, [*options.runs, *files.values()])
        runs = read_runs(options.runs, columns, segments=True, joints=named_joints(files))
        joints = joints_of(files, runs)
        known = () if columns is None else columns.known_loads
        scope, trust = scope_of(options.without, options.given, joints, known), dict(options.trust)
        for run in runs:
            for note in run.notes:
                print(f"{BY}: {run.name}: {note}", file=sys.stderr)
        limited = {number: with_limits(joint, options.limits) for number, joint in joints.items()}
        checked = usable(runs, limited, scope)
        findings = findings_of(runs, limited, checked, scope, options.relevance, trust)
        for line in (*checked.refused, *checked.notes):
            if line not in findings.reasons:  # which the summary has
                print(f"{BY}: {line}", file=sys.stderr)
        findings = replace(
            findings,
            joint_files=joints,
            relevance=options.relevance,
            trust=trust,
            provenance=_provenance(argv, runs, files, options.columns),
        )
        findings = replace(findings, next_experiment=_next_experiment(findings, options))
        mapping = _write(options.out, findings, joints, {run.name: run.sha256 for run in runs})
    except UsageError as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 2
    except (ConfigError, RunError, RunTableError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"{BY}: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr)
        return 1
    from jtqd.sysid.diagnosis.report import terminal_lines  # scipy, which --help does not need

    print(_json(mapping) if options.json else "\n".join(terminal_lines(findings)))
    print(f"{BY}: wrote {options.out / REPORT}", file=sys.stderr)
    return 0 if findings.verdict == NO_GAP else 3


def _json(mapping: Mapping[str, Any]) -> str:
    return json.dumps(mapping, indent=1, allow_nan=False)


def _own(directory: Path) -> list[Path]:
    """Return the files of a diagnosis in a directory."""
    return [path for pattern in _OWN for path in directory.glob(pattern)]


def _provenance(
    argv: Sequence[str], runs: Sequence[RunFile], files: Mapping[int, Path], columns: Path | None
) -> Provenance:
    """Return when and by what the findings were made, and of what; a joint file of several joints is named once."""
    inputs = {run.name: run.sha256 for run in runs}
    for path in dict.fromkeys([*files.values(), *([columns] if columns else [])]):
        name = str(path).encode(errors="backslashreplace").decode()  # it may hold other bytes than UTF-8
        inputs[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    command = shlex.join([*BY.split(), *argv]).encode(errors="backslashreplace").decode()
    return Provenance(dt.datetime.now().astimezone().date().isoformat(), __version__, command, inputs)


def _next_experiment(findings: Findings, options: argparse.Namespace) -> dict[str, Any] | None:
    """Return the next experiment with the command that runs its plan, and what it does not keep of --limits, or --limits of
    the joint files.
    """
    if findings.next_experiment is None:
        return None
    from jtqd.sysid.diagnosis.next_experiment import PLAN_FILE

    made, notes = dict(findings.next_experiment), []
    for number, joint in findings.joint_files.items():
        if wider := beyond_file(joint, options.limits):
            notes.append(f"--limits allows more than motion_limits of joint {number}: {wider}.")
    if made.get("plan"):
        plan = shlex.quote(str(options.out / PLAN_FILE))
        made["command"] = f"jtq campaign {plan} --bus can0 --config CONFIG --out RUNS"
        if "travel_rad" in (options.limits or {}):
            notes.append("A towing bench turns freely: travel_rad of --limits is not kept.")
    made["why"] = " ".join([made["why"], *notes])
    return made


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq diagnose`; nothing that it loads needs scipy."""
    parser = command_parser(
        BY,
        "Measure the error of a joint file's simulation on recorded runs and name its cause.\n"
        "If the runs cannot distinguish the possible causes, list them and plan the experiment that would.",
        "examples:\n"
        "  jtq diagnose campaigns/validate --joint models/joint1.yaml --out diagnosis\n"
        "  jtq diagnose a.csv b.csv.gz --joint 1=joint1.yaml --joint 2=joint2.yaml --out diagnosis --json\n"
        "  jtq diagnose rig/*.csv --columns columns.yaml --joint arm.yaml --out diagnosis\n"
        "  jtq diagnose rig/*.csv --columns columns.yaml --joint 3=arm3.yaml --without sensor_drift \\\n"
        "      --limits travel_rad=-0.5:0.5,velocity_rad_s=1 --out diagnosis\n\n"
        "--joint, --without, --given and --trust may be given again.\n"
        f"DIR/{REPORT} is for people, DIR/{FINDINGS} for programs, DIR/{EXTENDED} the joint file with the effects found;\n"
        "DIR/next_experiment.plan.yaml, when there is one, is for `jtq campaign`, DIR/next_experiment.motion.csv\n"
        "for the controller of an arm. Exit status: 0 no gap; 3 any other verdict; 1 failure; 2 usage.",
    )
    again: dict[str, Any] = {"action": "append", "default": []}

    def option(name: str, metavar: str, text: str, **more: Any) -> None:
        parser.add_argument(name, metavar=metavar, help=text, **more)

    add_runs(parser)
    option(
        "--joint", "[N=]FILE", "joint file of all joints, or of joint N (default: of the column map)", **again
    )
    option("--out", "DIR", "output directory; created if missing", type=Path, required=True)
    add_columns(parser)
    option(
        "--without",
        "[N=]EFFECT",
        "an effect that is absent (of joint N, or sensor=EFFECT)",
        type=effect_at,
        **again,
    )
    option(
        "--given",
        "[N=]EFFECT",
        "an effect that is as the joint file has it: not questioned",
        type=effect_at,
        **again,
    )
    trust = (
        "how far a value may be off, one standard deviation, in the unit of its prior: sensor_gain=5%%, "
        "channel_delay=5ms (defaults: priors in the report)"
    )
    option("--trust", "NAME=SIZE", trust, type=trusted, **again)
    limits = (
        "where the next experiment may move: travel_rad=LOW:HIGH, velocity_rad_s, acceleration_rad_s2, torque_nm "
        "(default: motion_limits of the joint file); never beyond what the runs did"
    )
    option("--limits", "NAME=VALUE,...", limits, type=motion_limits)
    relevance = "of the rated torque, rms: entries and what remains matter from here on (default 0.5)"
    option("--relevance", "PERCENT", relevance, type=_percent, default=RELEVANCE)
    force = "replace the results of an earlier diagnosis in DIR"
    parser.add_argument("--force", action="store_true", help=force)
    parser.add_argument("--json", action="store_true", help="print findings.json instead of the summary")
    return parser


Where = tuple[JointName | None, str]
"""Joint, "sensor" or None (wherever it may be), and effect."""


def effect_at(text: str) -> Where:
    """Return what an item [WHERE=]EFFECT of --without or --given is of. Raises argparse.ArgumentTypeError."""
    match = _ITEM.fullmatch(text)
    if match is None or match["name"] not in EFFECTS:
        raise argparse.ArgumentTypeError(
            f"{text}: found no effect of that name, expected NAME, N=NAME or sensor=NAME of {', '.join(sorted(EFFECTS))}"
        )
    where = match["where"]
    return where if where in (None, SENSOR) else int(where), match["name"]


def scope_of(
    without: Collection[Where],
    given: Collection[Where],
    joints: Mapping[int, Joint],
    known: Iterable[int] = (),
) -> Scope:
    """Return what is not looked for: effects that are absent, and effects that are as the joint files have them, in
    `effects` or as one of their values. known: joints whose torque is known.

    Raises UsageError for a joint that there is not, and for a given effect that no joint file has: it would be absent.
    """
    for where, name in (*without, *given):
        if where is not None and where != SENSOR and where not in joints:
            have = ", ".join(str(number) for number in sorted(joints))
            raise UsageError(f"{where}={name}: found no joint {where} in runs and joint files: {have}")
    for where, name in given:
        of = [joint for n, joint in joints.items() if where in (None, SENSOR, n)]
        listed = any(effect.name == name for joint in of for effect in joint.effects)
        if not listed and not any(p.key for p in EFFECTS[name].parameters):
            raise UsageError(
                f"--given {name}: found it neither among the effects of a joint file nor as one of its values, expected "
                f"it there, or --without {name}"
            )
    return Scope(frozenset((*without, *given)), frozenset(known))


def trusted(text: str) -> tuple[str, float]:
    """Return the name of a prior (`limits.PRIORS`) and the factor on its size that an item NAME=SIZE of --trust asks for.

    SIZE: how far a value may be off, as a standard deviation, in the unit of the prior ("sensor_gain=5%": five times the
    default of 1 %; "channel_delay=5ms"). Raises argparse.ArgumentTypeError.
    """
    name, _, asked = text.partition("=")
    if name not in PRIORS:
        names = ", ".join(sorted(PRIORS))
        raise argparse.ArgumentTypeError(f"found {name!r}, expected NAME=SIZE with one of {names}")
    default, size = _SIZE.match(PRIORS[name].text), _SIZE.fullmatch(asked.strip())
    assert default is not None, f"the prior of {name} has no size in a unit"
    if size is None or not 0.0 < float(size[1]) < math.inf or size[2] != default[2]:
        raise argparse.ArgumentTypeError(
            f"{name}: found {asked!r}, expected a number above 0 with the unit {default[2]} (default {PRIORS[name].text})"
        )
    return name, float(size[1]) / float(default[1])


def motion_limits(text: str) -> dict[str, Any]:
    """Return the limits of a text such as "travel_rad=-0.5:0.5,velocity_rad_s=1". Raises argparse.ArgumentTypeError."""
    try:
        return parsed_limits(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _percent(text: str) -> float:
    """Return a percentage above 0 and up to 100 as a part. Raises argparse.ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= 100.0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected percent above 0 and up to 100")
    return value / 100.0


def _check_out(directory: Path, force: bool, inputs: Sequence[Path]) -> None:
    """Make DIR before minutes of work; refuse to overwrite, an input in any case. Raises ConfigError."""
    there = _own(directory)
    own = {path.resolve() for path in there}
    if used := next((path for path in inputs if path.resolve() in own), None):
        raise ConfigError(f"--out {directory}: found the input {used} there, expected another directory")
    make_directory(directory)
    if there and not force:
        names = ", ".join(path.name for path in there)
        raise ConfigError(
            f"--out {directory}: found {names} in it, expected a directory without a diagnosis, or --force"
        )


def _write(
    directory: Path, findings: Findings, joints: Mapping[int, Joint], sha256: Mapping[str, str]
) -> dict[str, Any]:
    """Put all files in place and return what is in findings.json. Raises ConfigError, OSError.

    They are made in a directory beside first: what fails on the way leaves the earlier results as they were. Then what
    an earlier diagnosis wrote goes.
    """
    from jtqd.sysid.diagnosis.next_experiment import PLAN_FILE
    from jtqd.sysid.diagnosis.report import render

    origin = {"sha256": sha256, "date": findings.provenance.date if findings.provenance else ""}
    experiment = findings.next_experiment or {}
    texts = dict(experiment.get("tables", {}))
    if experiment.get("plan"):
        texts[PLAN_FILE] = Plan.from_mapping(experiment["plan"], PLAN_FILE).to_yaml()
    texts[REPORT] = render(findings)
    with tempfile.TemporaryDirectory(prefix=".diagnosis.", dir=directory) as made:
        fresh = Path(made)
        names = [*write_extended(fresh, joints, findings, **origin), *texts]
        mapping = to_mapping(findings, sha256=sha256, files=names)
        texts[FINDINGS] = f"{_json(mapping)}\n"
        for name, text in texts.items():
            (fresh / name).write_text(text, encoding="utf-8")
        for path in _own(directory):
            if path.name not in {*names, FINDINGS}:
                path.unlink()
        for name in (*names, FINDINGS):
            write_whole(directory / name, (fresh / name).read_bytes())
    return mapping


def extended(joint: Joint, number: int, findings: Findings, *, sha256: Mapping[str, str], date: str) -> Joint:
    """Return the joint with what predicts: values of the file replaced, effects of joint `number` and of the sensor among
    its effects, which are relative to the values replaced. What predicts replaces an effect of the same name. What only
    makes the prediction better, and is no entry found, is listed by name in the provenance.

    sha256: hash of each run's file by name, those that were used are kept; date: ISO 8601. Raises ConfigError for an effect
    or a value that joint files do not allow.
    """
    causes = [c for c in (*findings.causes, *findings.too_small) if shows_at(c.joint, number)]
    found = [p for p in findings.predicts if shows_at(p.joint, number)]
    replaced = {p.name for p in found}
    effects = [effect for effect in joint.effects if effect.name not in replaced]
    effects += [Effect(p.name, {name: _rounded(value) for name, value in p.values.items()}) for p in found]
    record: dict[str, Any] = {"by": "jtq diagnose", "date": date, "verdict": findings.verdict}
    if causes:
        record["effects"] = [_record(cause) for cause in causes]
    only = replaced - {cause.name for cause in causes}
    if only:
        record["better_prediction_only"] = sorted(only)
    gain = findings.gain
    if causes and gain is not None and math.isfinite(gain.rmse_before_nm + gain.rmse_after_nm):
        before, after = _rounded(gain.rmse_before_nm), _rounded(gain.rmse_after_nm)
        record["gain"] = {"rmse_before_nm": before, "rmse_after_nm": after, "split": gain.split}
    record["sha256"] = {name: sha256[name] for name in findings.used_runs if name in sha256}
    whole = replace(joint, effects=tuple(effects), provenance={**joint.provenance, "diagnosis": record})
    return with_effects_applied(whole)


def extended_title(number: int, findings: Findings) -> str:
    """First line of an extended joint file."""
    names = [cause.name for cause in findings.causes if shows_at(cause.joint, number)]
    what = f"found {', '.join(names)}" if names else "found no effect of this joint to add"
    return f"Written by jtq diagnose from {findings.runs_text}: {what} (verdict {findings.verdict})."


def write_extended(
    directory: Path, joints: Mapping[int, Joint], findings: Findings, **origin: Any
) -> list[str]:
    """Write the extended file of the joint with the largest cause, and of several joints each; returns their names."""
    largest = [*(c.joint for c in findings.causes), *(g.joint for g in findings.gaps), *sorted(joints)]
    names = {EXTENDED: next(int(n) for n in largest if n in joints)}
    names |= {f"extended.joint{n}.yaml": n for n in sorted(joints) if len(joints) > 1}
    for name, number in names.items():
        joint = extended(joints[number], number, findings, **origin)
        write_joint(directory / name, joint, extended_title(number, findings))
    return list(names)


def _record(cause: Cause) -> dict[str, Any]:
    """Return a cause for the provenance; an end of an interval that is none is None: NaN would not read back as itself."""
    record: dict[str, Any] = {"name": cause.name, "joint": cause.joint, "grade": cause.grade}
    if len(cause.names) > 1:
        record["cannot_be_told_from"] = list(cause.names[1:])
    record["ci95"] = {
        name: [_rounded(end) if math.isfinite(end) else None for end in value.ci95]
        for name, value in cause.parameters.items()
    }
    return record


def _rounded(value: float) -> float:
    return float(f"{float(value):.{_DIGITS}g}")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
