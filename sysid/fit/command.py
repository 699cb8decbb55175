"""`jtq fit efficiency|friction|losses`: fit one section of a joint file to measured runs and write it into a new file."""

from __future__ import annotations

import argparse
import datetime as dt
import difflib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.estimator.checked import ConfigError, check_installed, check_output, counted
from jtqd.estimator.joint import CONVENTIONS, QUADRANTS, Joint
from jtqd.estimator.run import RunTableError
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint
from jtqd.sysid.fit.efficiency import (
    EfficiencyFit,
    EfficiencyResult,
    as_mapping,
    default_current_min,
    efficiency_findings,
    eta_points,
    fit_efficiency,
    plateau_mapping,
    report_lines,
    written_findings,
)
from jtqd.sysid.fit.few_runs import MOST_RUNS, FewRunsFit, fit_few_runs
from jtqd.sysid.fit.friction import FitError, NoLoadFit, fit_no_load, no_load
from jtqd.sysid.fit.fused import FusedFit, fit_fused
from jtqd.sysid.fit.joint_writer import with_fit, write_joint
from jtqd.sysid.fit.losses import PER_K_PRIOR, LossFitError
from jtqd.sysid.fit.plateaus import Plateau, PlateauError, PlateauRules, plateaus_of
from jtqd.sysid.fit.signals import RunSignals, run_signals
from jtqd.sysid.fit.torsion import TorsionError
from jtqd.sysid.progress import progress
from jtqd.sysid.report.figures import check_picture
from jtqd.sysid.runs.checks import channel_findings
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.joints import joint_number, only, with_joint
from jtqd.sysid.runs.run_file import RunError, RunFile


def fit_parser(kind: str, description: str, examples: str) -> argparse.ArgumentParser:
    """Parser with RUNS, --joint, --number, --out, --columns and --json; the kind adds its own."""
    parser = argparse.ArgumentParser(
        prog=f"jtq fit {kind}",
        description=description,
        epilog=f"examples:\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs",
        nargs="+",
        type=Path,
        metavar="RUNS",
        help="run files (.csv, .csv.gz, .parquet, .mcap) or directories of them",
    )
    parser.add_argument("--joint", type=Path, required=True, metavar="FILE", help="joint file to start from")
    parser.add_argument(
        "--number",
        type=int,
        choices=range(1, 8),
        metavar="N",
        help="number of the joint in the runs (default: the last digit of its name)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="joint file to write (default: only the report)"
    )
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map for other names, units and signs"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    return parser


def add_plateau_options(parser: argparse.ArgumentParser) -> None:
    """--min-hold and --min-current of the fits that rest on plateaus."""
    parser.add_argument(
        "--min-hold",
        type=positive,
        default=PlateauRules().shortest_s,
        metavar="S",
        help="shortest plateau in seconds (default %(default)s)",
    )
    parser.add_argument(
        "--min-current",
        type=positive,
        metavar="A",
        help="current below which eta is not computed (default: the current that overcomes the joint's own static friction)",
    )


def parse_fit(parser: argparse.ArgumentParser, argv: list[str]) -> argparse.Namespace:
    """Parse; the joint file that is read is never the one that is written."""
    options = parser.parse_args(argv)
    if options.out is not None and options.out.resolve() == options.joint.resolve():
        parser.error(f"--out: found {options.out}, the joint file itself, expected a new file")
    return options


def positive(text: str) -> float:
    """argparse type: a finite number > 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number > 0")
    return value


def today() -> str:
    """Return the date of a fit, ISO 8601, local time."""
    return dt.datetime.now().astimezone().date().isoformat()


EFFICIENCY_BY = "jtq fit efficiency"


def efficiency_main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    options = parse_fit(efficiency_parser(), argv)
    try:
        joint = load_joint(options.joint)
        if options.out is not None:
            check_output(options.out)
        if options.plot is not None:
            check_installed("analysis", "matplotlib")
            check_picture(options.plot)
        runs = read_runs(options.runs, options.columns, joints=only(options.number))
        number = joint_number(options.number, joint, runs)
        runs = with_joint(runs, number)
        result = analyse(joint, runs, number, options)
        written = None if result.findings else _new_joint(joint, result, options)
        if written is not None:
            result = replace(result, findings=tuple(written_findings(written, result.points, result.fits[0])))
        print(json.dumps(as_mapping(result), indent=1) if options.json else "\n".join(report_lines(result)))
        if options.plot is not None and result.fits:
            _draw(joint, result, options.plot)
        if result.findings or written is None:
            return _refuse(result, options)
        if options.out is not None:
            write_joint(options.out, written, f"Written by {EFFICIENCY_BY} from {len(runs)} runs.")
            print(f"{EFFICIENCY_BY}: wrote {options.out}", file=sys.stderr)
    except (ConfigError, RunError, RunTableError, PlateauError, OSError) as error:
        print(f"{EFFICIENCY_BY}: {error}", file=sys.stderr)
        return 1
    return 0


def analyse(joint: Joint, runs: list[RunFile], number: int, options: argparse.Namespace) -> EfficiencyResult:
    """Everything but files: channels, plateaus, points, fits.

    A run whose channels contradict each other ends it there: what follows from them is not worth a look. Raises
    PlateauError and RunTableError.
    """
    hashes = {run.name: run.sha256 for run in runs}
    current_min = options.min_current or default_current_min(joint)
    found = channel_findings(runs, number, joint)
    if found:
        return EfficiencyResult(joint.name, number, hashes, (), (), current_min, (), tuple(found))
    plateaus = plateaus_of(runs, number, joint, PlateauRules(shortest_s=options.min_hold))
    points, left_out = eta_points(plateaus, joint, current_min)
    found = efficiency_findings(points, joint)
    fits: list[EfficiencyFit] = []
    if not found:
        written = options.convention, options.weighted
        kinds = [written, (options.convention, not options.weighted), (CONVENTIONS[0], options.weighted)]
        fits = [fit_efficiency(points, c, joint, weighted=w) for c, w in dict.fromkeys(kinds)]
    return EfficiencyResult(
        joint.name, number, hashes, tuple(points), tuple(left_out), current_min, tuple(fits), tuple(found)
    )


def efficiency_parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq fit efficiency`."""
    parser = fit_parser(
        "efficiency",
        "Fit the paper's Eq. (8) to the plateaus of measured runs, quadrant by quadrant.",
        "  jtq fit efficiency campaigns/efficiency --joint joint1.yaml --out joint1.fitted.yaml --plot fig6.png\n"
        "  jtq fit efficiency runs/*.csv --joint joint2.yaml --number 2 --json",
    )
    add_plateau_options(parser)
    parser.add_argument(
        "--convention",
        choices=CONVENTIONS,
        default=CONVENTIONS[0],
        help="eta = tau_j/(G Kt i) as in Table I (default), or its reciprocal as in Eq. (6)",
    )
    parser.add_argument(
        "--weighted",
        action="store_true",
        help="weight plateaus by their standard errors and the sensor's zero",
    )
    parser.add_argument(
        "--allow-missing",
        action="store_true",
        help="keep the joint file's coefficients for quadrants that cannot be fitted",
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="plot like Fig. 6 (png, svg, pdf)")
    return parser


def _new_joint(joint: Joint, result: EfficiencyResult, options: argparse.Namespace) -> Joint | None:
    """Return the joint with its new efficiency; None when a quadrant is refused and that was not allowed."""
    fit = result.fits[0]
    if fit.refused and not options.allow_missing:
        return None
    try:
        efficiency = fit.efficiency(joint.efficiency if options.allow_missing else None)
    except ValueError as error:
        raise ConfigError(f"{options.joint}: {error}") from None
    notes: dict[str, object] = {"weighted": fit.weighted, "plateaus": len(result.points)}
    if fit.refused:
        notes["kept_from_joint_file"] = list(fit.refused)
    return with_fit(
        replace(joint, efficiency=efficiency),
        "efficiency",
        by=EFFICIENCY_BY,
        runs=result.runs,
        date=today(),
        temperature_c=result.temperature_c,
        notes=notes,
    )


def _refuse(result: EfficiencyResult, options: argparse.Namespace) -> int:
    """Report on standard error why nothing was written; returns the exit status."""
    nothing = f"nothing was written to {options.out}" if options.out is not None else "not fitted"
    if result.findings:
        count = len(result.findings)
        print(f"{EFFICIENCY_BY}: {count} finding{'s' if count > 1 else ''}, {nothing}", file=sys.stderr)
        return 3
    for text in result.fits[0].refused.values():
        print(
            f"{EFFICIENCY_BY}: {text} (--allow-missing keeps the joint file's own); {nothing}",
            file=sys.stderr,
        )
    return 1


def _draw(joint: Joint, result: EfficiencyResult, path: Path) -> None:
    from jtqd.sysid.fit.efficiency import draw_fit

    title = f"{joint.name}: measured efficiency and Eq. (8), convention {result.fits[0].convention}"
    try:
        draw_fit(result.points, result.fits[0], title, path)
    except ValueError as error:  # matplotlib's own: an ending that it does not know
        raise ConfigError(f"--plot {path}: {error}") from None
    print(f"{EFFICIENCY_BY}: wrote {path}", file=sys.stderr)


FRICTION_BY = "jtq fit friction"


def friction_parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq fit friction`."""
    parser = fit_parser(
        "friction",
        "Fit Coulomb and viscous friction to the plateaus at no load (motor current or joint torque near zero).",
        "  jtq fit friction campaigns/efficiency --joint joint1.yaml --out joint1.friction.yaml",
    )
    add_plateau_options(parser)
    return parser


def friction_main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    options = parse_fit(friction_parser(), argv)
    try:
        joint = load_joint(options.joint)
        if options.out is not None:
            check_output(options.out)
        runs = read_runs(options.runs, options.columns, joints=only(options.number))
        number = joint_number(options.number, joint, runs)
        runs = with_joint(runs, number)
        found = channel_findings(runs, number, joint)
        if found:
            for item in found:
                print(f"{item.kind}: {item.text}")
            print(
                f"{FRICTION_BY}: {len(found)} finding{'s' if len(found) > 1 else ''}, not fitted",
                file=sys.stderr,
            )
            return 3
        plateaus = plateaus_of(runs, number, joint, PlateauRules(shortest_s=options.min_hold))
        chosen = no_load(plateaus, joint, options.min_current or default_current_min(joint))
        fit = fit_no_load(chosen, joint)
        if options.json:
            print(json.dumps(_friction_mapping(joint, number, fit, chosen), indent=1))
        else:
            print("\n".join([f"{joint.name} (j{number}): friction at no load", *fit.lines()]))
        if options.out is not None:
            temperatures = [p.temperature_c for p in chosen if math.isfinite(p.temperature_c)]
            new = with_fit(
                replace(joint, friction=fit.friction),
                "friction",
                by=FRICTION_BY,
                runs={run.name: run.sha256 for run in runs},
                date=today(),
                temperature_c=float(np.mean(temperatures)) if temperatures else math.nan,
                notes={"plateaus": fit.plateaus},
            )
            write_joint(options.out, new, f"Written by {FRICTION_BY} from {len(runs)} runs.")
            print(f"{FRICTION_BY}: wrote {options.out}", file=sys.stderr)
    except (ConfigError, RunError, RunTableError, PlateauError, FitError, OSError) as error:
        print(f"{FRICTION_BY}: {error}", file=sys.stderr)
        return 1
    return 0


def _friction_mapping(
    joint: Joint, number: int, fit: NoLoadFit, plateaus: Sequence[Plateau]
) -> dict[str, Any]:
    return {
        "schema": "jtq.friction/1",
        "joint": joint.name,
        "number": number,
        "friction": asdict(fit.friction),
        "terms": [{"name": t.name, "value": t.value, "ci95": t.ci95} for t in fit.terms],
        "rmse_nm": fit.rmse_nm,
        "warnings": list(fit.warnings),
        "plateaus": [plateau_mapping(plateau) for plateau in plateaus],
    }


LOSSES_BY = "jtq fit losses"
_EXAMPLE = (
    "  jtq fit losses campaigns/excitation --joint joint1.yaml --out joint1.fused.yaml\n"
    "The runs must excite load, speed and both directions; `jtq campaign excitation` records them.\n"
    f"With one encoder one to {MOST_RUNS} runs will do, with a wider sigma."
)


def losses_parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq fit losses`."""
    return fit_parser(
        "losses", "Additive loss over load, speed, direction and temperature; torsion; sigma.", _EXAMPLE
    )


def losses_main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    options = parse_fit(losses_parser(), argv)
    try:
        joint = load_joint(options.joint)
        if options.out is not None:
            check_output(options.out)
        runs = read_runs(options.runs, options.columns, joints=only(options.number))
        number = joint_number(options.number, joint, runs)
        runs = with_joint(runs, number)
        findings = channel_findings(runs, number, joint)
        if findings:
            for finding in findings:
                print(f"{LOSSES_BY}: {finding.text}", file=sys.stderr)
            return 3
        two = two_encoders(runs, number, joint)
        signals = signals_of(runs, number, joint)
        if not two:
            print(f"{LOSSES_BY}: {ONE_ENCODER}", file=sys.stderr)
        if not two and len(runs) <= MOST_RUNS:
            few = fit_few_runs(signals, joint)
            print(f"{LOSSES_BY}: {FEW_RUNS}", file=sys.stderr)
            written = _with_few(few, runs)
            told, lines = _few_mapping(few), _few_lines(few)
        else:
            fit = fit_fused(signals, joint.friction, joint.rated_torque_nm, with_torsion=two)
            written = _with_fused(joint, fit, runs)
            told, lines = _losses_mapping(fit), _lines(joint, fit)
        print(json.dumps(told, indent=1) if options.json else "\n".join(lines))
        if options.out is not None:
            write_joint(options.out, written, f"Written by {LOSSES_BY} from {counted(len(runs), 'run')}.")
            print(f"{LOSSES_BY}: wrote {options.out}", file=sys.stderr)
    except (ConfigError, RunError, RunTableError, LossFitError, TorsionError, ValueError, OSError) as error:
        print(f"{LOSSES_BY}: {error}", file=sys.stderr)
        return 1
    return 0


ONE_ENCODER: Final = (
    "the runs have one encoder of this joint: no torsion is fitted, sigma is that of motor current less loss"
)
FEW_RUNS: Final = (
    f"up to {MOST_RUNS} runs: what they do not tell stays near the joint file and widens sigma "
    "(docs/results.md)"
)


def two_encoders(runs: list[RunFile], number: int, joint: Joint) -> bool:
    """Return whether the runs have both encoders of a joint. Raises RunTableError where some have and some have not."""
    without = [run.name for run in runs if not run.table.joints[number].two_encoders(joint.gear_ratio)]
    if without and len(without) < len(runs):
        raise RunTableError(
            f"{without[0]}: j{number}: found one position, other runs have both, expected both in all runs or in none"
        )
    return not without


def signals_of(runs: list[RunFile], number: int, joint: Joint) -> list[RunSignals]:
    """Return what fits of the fused estimator see of one joint in all runs, with a progress bar on a terminal."""
    settings = EstimatorSettings(method="fused")
    return [
        run_signals(run.name, joint, settings, run.table.time_s, run.table.joint(number, joint.gear_ratio))
        for run in progress(runs, f"observing {joint.name}")
    ]


def _with_fused(joint: Joint, fit: FusedFit, runs: list[RunFile]) -> Joint:
    return with_fit(
        replace(joint, fused=fit.fused),
        "fused",
        by=LOSSES_BY,
        runs={Path(run.name).name: run.sha256 for run in runs},
        date=today(),
        temperature_c=fit.fused.loss.temperature_c,
        notes={"unseen_rmse_nm": round(_unseen(fit), 4)},
    )


def _with_few(fit: FewRunsFit, runs: list[RunFile]) -> Joint:
    return with_fit(
        fit.joint,
        "fused",
        by=LOSSES_BY,
        runs={Path(run.name).name: run.sha256 for run in runs},
        date=today(),
        temperature_c=fit.fused.loss.temperature_c,
        notes={
            "unseen_rmse_nm": round(fit.unseen_nm, 4),
            "few_runs": fit.lines(),
            "rotor_inertia_kgm2": "fitted, too",
        },
    )


def _few_mapping(fit: FewRunsFit) -> dict[str, object]:
    """Return the mapping of `_losses_mapping`, and what few runs told of each thing."""
    return {
        "schema": "jtq.fit_losses/1",
        "unseen_rmse_nm": [fit.unseen_nm],
        "samples": fit.samples,
        "viscous_per_k_sigma": PER_K_PRIOR[1],
        "effective_samples": fit.effective,
        "terms": [asdict(term) for term in fit.terms],
        "rotor_inertia_kgm2": fit.joint.rotor_inertia_kgm2,
        "fused": fit.fused.to_mapping(),
    }


def _few_lines(fit: FewRunsFit) -> list[str]:
    sigma = fit.fused.sigma
    scale = "/".join(f"{each:.2f}" for each in sigma.scale)
    return [
        f"{fit.joint.name}: few runs, one encoder",
        *(f"  {line}" for line in fit.lines()),
        f"  sigma of the torque on another day {sigma.current_nm:.2f} Nm, {sigma.viscous_nms_per_rad:.2f} Nms/rad, "
        f"{100 * sigma.load:.1f} % of load, times {scale} by quadrant ({', '.join(QUADRANTS)})",
    ]


def _unseen(fit: FusedFit) -> float:
    return float(np.sqrt(np.mean(np.square(fit.unseen_rmse_nm))))


def _losses_mapping(fit: FusedFit) -> dict[str, object]:
    return {
        "schema": "jtq.fit_losses/1",
        "unseen_rmse_nm": list(fit.unseen_rmse_nm),
        "samples": fit.loss.samples,
        "viscous_per_k_sigma": fit.loss.viscous_per_k_sigma,
        "fused": fit.fused.to_mapping(),
    }


def _lines(joint: Joint, fit: FusedFit) -> list[str]:
    sigma, torsion, loss = fit.fused.sigma, fit.fused.torsion, fit.fused.loss
    lines = [
        f"{joint.name}: physics on held-out runs: RMSE {_unseen(fit):.3f} Nm "
        f"({100 * _unseen(fit) / joint.rated_torque_nm:.2f} % of rated), worst run {max(fit.unseen_rmse_nm):.3f} Nm",
        f"  loss: {fit.loss.samples} samples, viscous friction falls {100 * loss.viscous_per_k:.1f} "
        f"+- {196 * fit.loss.viscous_per_k_sigma:.1f} % per kelvin",
        f"  sigma of the current path {sigma.current_nm:.2f} Nm, {sigma.viscous_nms_per_rad:.2f} Nms/rad, "
        f"{100 * sigma.load:.1f} % of load"
        + (
            ""
            if torsion is None
            else f"; of the torsion {sigma.torsion_nm:.2f} Nm; of the sensor's zero {sigma.reference_nm:.2f} Nm"
        ),
    ]
    if torsion is not None:
        amplitude = np.hypot(torsion.cos_rad, torsion.sin_rad) * 1e6
        lines.append(
            f"  stiffness {torsion.stiffness_nm_per_rad:.0f} Nm/rad (file: {joint.stiffness_nm_per_rad:.0f}), kinematic "
            f"error {amplitude[0]:.0f} urad at 2 per motor revolution, {amplitude[1]:.0f} at 4"
        )
    agreement = fit.fused.agreement
    if agreement is not None:
        lines.append(
            f"  current and torsion differ by up to {agreement.slow_nm:.2f} Nm slowly and {agreement.fast_nm:.2f} Nm "
            "over the motor's turn; sigma grows beyond"
        )
    zeros = fit.fused.zeros
    if zeros is not None:
        lines.append(
            f"  the link encoder's zero differs by {1e6 * zeros.spread_rad:.0f} urad, {zeros.spread_nm:.2f} Nm, from day to "
            "day; with track_zeros it is learned"
        )
    standstill = fit.fused.standstill
    if standstill is not None:
        lines.append(
            f"  at rest the interval is {standstill.sigmas:.2f} standard deviations and what slip and friction leave open"
        )
    elif torsion is not None:
        lines.append("  too few runs come to rest to calibrate the interval there: 3 standard deviations")
    tracking = fit.fused.tracking
    if tracking is not None:
        lines.append(
            f"  with the torsion tracked, an estimate of now: {tracking.sigma_nm:.2f} Nm and "
            f"{tracking.viscous_nms_per_rad:.2f} Nms/rad more, added as squares, the latter bent above "
            f"{tracking.saturation_rad_s:g} rad/s"
        )
    return lines


KINDS: Final = {
    "efficiency": (efficiency_main, "efficiency: Eq. (8) per quadrant, from plateaus"),
    "friction": (
        friction_main,
        "Coulomb and viscous friction at no load, from plateaus",
    ),
    "losses": (losses_main, "additive loss over load and velocity, from whole runs"),
}
"""Kind -> (its `main(argv) -> int`, one line of help)."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq fit`, a subcommand for each kind."""
    parser = argparse.ArgumentParser(
        prog="jtq fit",
        description="Fit one section of a joint file to measured runs and write a new joint file.",
    )
    kinds = parser.add_subparsers(dest="kind", metavar="KIND")
    for name, made in (
        ("efficiency", efficiency_parser()),
        ("friction", friction_parser()),
        ("losses", losses_parser()),
    ):
        kinds.add_parser(
            name,
            help=KINDS[name][1],
            description=made.description,
            epilog=made.epilog,
            parents=[made],
            add_help=False,
        )
    return parser


def main(argv: list[str]) -> int:
    """Hand over to the kind's command; exit status 0 done, 1 failure, 2 usage, 3 done with findings."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_help(), end="")
        return 0 if argv else 2
    kind = KINDS.get(argv[0])
    if kind is None:
        near = difflib.get_close_matches(argv[0], KINDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"jtq fit: found {argv[0]!r}, expected one of {', '.join(KINDS)}{hint}", file=sys.stderr)
        return 2
    return kind[0](argv[1:])


def _help() -> str:
    width = max(map(len, KINDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in KINDS.items())
    return (
        "usage: jtq fit KIND RUNS... --joint JOINT.yaml --out NEW_JOINT.yaml ...\n\n"
        "Fit one section of a joint file to measured runs and write a new joint file.\n\n"
        f"kinds:\n{rows}\n\n"
        "examples:\n"
        "  jtq fit efficiency campaigns/efficiency --joint joint1.yaml --out joint1.fitted.yaml --plot fig6.png\n"
        "  jtq fit KIND --help\n"
    )
