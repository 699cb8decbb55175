"""`jtq fit efficiency|friction|losses`: fit one section of a joint file to measured runs and write it into a new file."""

from __future__ import annotations

import argparse
import datetime as dt
import difflib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.command_line import HelpFormatter, check_installed, check_output, command_parser
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import CONVENTIONS, QUADRANTS, Joint
from jtqd.estimator.text import counted
from jtqd.models.files import load_joint
from jtqd.sysid.fit.efficiency import (
    EfficiencyFit,
    EfficiencyResult,
    as_mapping,
    default_current_min,
    draw_fit,
    efficiency_findings,
    eta_points,
    fit_efficiency,
    report_lines,
    written_findings,
)
from jtqd.sysid.fit.few_runs import MOST_RUNS, FewRunsFit, fit_few_runs
from jtqd.sysid.fit.fused import FusedFit, fit_fused
from jtqd.sysid.fit.joint_writer import with_fit, write_joint
from jtqd.sysid.fit.known_load import STIFFNESS_KNOWN, WEIGHT, fit_teacher
from jtqd.sysid.fit.losses import PER_K_PRIOR, LossFitError
from jtqd.sysid.fit.plateaus import SHORTEST_S, fit_no_load, mean_temperature, no_load, plateaus_of
from jtqd.sysid.fit.signals import RunSignals, signals_of_runs, two_encoders
from jtqd.sysid.fit.torsion import TorsionError
from jtqd.sysid.report.page import check_picture
from jtqd.sysid.runs.checks import channel_findings
from jtqd.sysid.runs.options import add_columns, add_number, add_runs, runs_of_joint
from jtqd.sysid.runs.run_file import RunError, RunFile


class Outcome(NamedTuple):
    """What one kind of fit gives: text and JSON for standard output, lines for standard error, the joint to write.

    status: exit status; other than 0, nothing is written.
    """

    lines: Sequence[str] = ()
    mapping: Mapping[str, Any] | None = None
    log: Sequence[str] = ()
    joint: Joint | None = None
    status: int = 0


class Kind(NamedTuple):
    """One kind of fit: help, description, epilog of the parser, its own options, and the fit."""

    help: str
    description: str
    examples: str
    options: Callable[[argparse.ArgumentParser], None]
    fit: Callable[[Joint, int, list[RunFile], argparse.Namespace], Outcome]


def main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    if argv and argv[0] not in (*KINDS, "-h", "--help"):
        near = difflib.get_close_matches(argv[0], KINDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"jtq fit: found {argv[0]!r}, expected one of {', '.join(KINDS)}{hint}", file=sys.stderr)
        return 2
    if not argv or argv[0] not in KINDS:
        print(parser().format_help(), end="")
        return 0 if argv else 2
    options = parser().parse_args(argv)
    by = f"jtq fit {options.kind}"
    if options.out is not None and options.out.resolve() == options.joint.resolve():
        found = f"found {options.out}, the joint file itself, expected a new file"
        print(f"{by}: --out: {found}", file=sys.stderr)
        return 2
    try:
        joint = load_joint(options.joint)
        if options.out is not None:
            check_output(options.out)
        if getattr(options, "plot", None) is not None:
            check_installed("analysis", "matplotlib")
            check_picture(options.plot)
        runs, number = runs_of_joint(options, joint)
        outcome = KINDS[options.kind].fit(joint, number, runs, options)
        if options.json and outcome.mapping is not None:
            print(json.dumps(outcome.mapping, indent=1))
        elif outcome.lines:
            print("\n".join(outcome.lines))
        for line in outcome.log:
            print(f"{by}: {line}", file=sys.stderr)
        if options.out is not None and outcome.joint is not None and not outcome.status:
            write_joint(options.out, outcome.joint, f"Written by {by} from {counted(len(runs), 'run')}.")
            print(f"{by}: wrote {options.out}", file=sys.stderr)
    except (RunError, ValueError, OSError) as error:
        print(f"{by}: {error}", file=sys.stderr)
        return 1
    return outcome.status


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq fit`, a subcommand for each kind."""
    parser = command_parser(
        "jtq fit",
        "Fit one section of a joint file to measured runs and write a new joint file.",
        "examples:\n"
        "  jtq fit efficiency campaigns/efficiency --joint joint1.yaml --out joint1.fitted.yaml --plot fig6.png\n"
        "  jtq fit KIND --help",
    )
    kinds = parser.add_subparsers(dest="kind", metavar="KIND")
    for name, kind in KINDS.items():
        own = kinds.add_parser(
            name,
            help=kind.help,
            description=kind.description,
            epilog=f"examples:\n{kind.examples}",
            formatter_class=HelpFormatter,
        )
        add = own.add_argument
        add_runs(own)
        add("--joint", type=Path, required=True, metavar="FILE", help="joint file to start from")
        add_number(own)
        add("--out", type=Path, metavar="FILE", help="joint file to write (default: only the report)")
        add_columns(own)
        add("--json", action="store_true", help="print the result as JSON")
        kind.options(own)
    return parser


def _plateau_options(parser: argparse.ArgumentParser) -> None:
    """Add --min-hold and --min-current, of the fits to plateaus."""
    add, eta = parser.add_argument, "current below which eta is not computed"
    hold = "shortest plateau in seconds (default %(default)s)"
    usual = f"{eta} (default: the current that overcomes the joint's own static friction)"
    add("--min-hold", type=_positive, default=SHORTEST_S, metavar="S", help=hold)
    add("--min-current", type=_positive, metavar="A", help=usual)


def _positive(text: str) -> float:
    """argparse type: a finite number > 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number > 0")
    return value


def _fitted(
    joint: Joint, section: str, runs: Sequence[RunFile], by: str, temperature_c: float, **notes: Any
) -> Joint:
    """Return the joint with today's date, the command and the hashes of the runs in the provenance of a section."""
    hashes = {run.name: run.sha256 for run in runs}
    today = dt.datetime.now().astimezone().date().isoformat()
    return with_fit(
        joint, section, by=f"jtq fit {by}", runs=hashes, date=today, temperature_c=temperature_c, notes=notes
    )


# Efficiency --------------------------------------------------------------------------------------------


def _efficiency_options(parser: argparse.ArgumentParser) -> None:
    _plateau_options(parser)
    add = parser.add_argument
    eta = "eta = tau_j/(G Kt i) as in Table I (default), or its reciprocal as in Eq. (6)"
    weighted = "weight plateaus by their standard errors and the sensor's offset"
    missing = "keep the joint file's coefficients for quadrants that cannot be fitted"
    add("--convention", choices=CONVENTIONS, default=CONVENTIONS[0], help=eta)
    add("--weighted", action="store_true", help=weighted)
    add("--allow-missing", action="store_true", help=missing)
    add("--plot", type=Path, metavar="FILE", help="plot like Fig. 6 (png, svg, pdf)")


def _fit_efficiency(joint: Joint, number: int, runs: list[RunFile], options: argparse.Namespace) -> Outcome:
    result = _efficiency_result(joint, number, runs, options)
    fit = result.fits[0] if result.fits else None
    written = None
    log = []
    if fit is not None and (not fit.refused or options.allow_missing):
        try:
            efficiency = fit.efficiency(joint.efficiency if options.allow_missing else None)
        except ValueError as error:
            raise ConfigError(f"{options.joint}: {error}") from None
        kept = {"kept_from_joint_file": list(fit.refused)} if fit.refused else {}
        written = _fitted(
            replace(joint, efficiency=efficiency),
            "efficiency",
            runs,
            "efficiency",
            result.temperature_c,
            weighted=fit.weighted,
            plateaus=len(result.points),
            **kept,
        )
        result = replace(result, findings=tuple(written_findings(written, result.points, fit)))
    if fit is not None and options.plot is not None:
        title = f"{joint.name}: measured efficiency and Eq. (8), convention {fit.convention}"
        try:
            draw_fit(result.points, fit, title, options.plot)
        except ValueError as error:  # matplotlib's own: an ending that it does not know
            raise ConfigError(f"--plot {options.plot}: {error}") from None
        log.append(f"wrote {options.plot}")
    nothing = f"nothing was written to {options.out}" if options.out is not None else "not fitted"
    status = 0
    if result.findings:
        log.append(f"{counted(len(result.findings), 'finding')}, {nothing}")
        status = 3
    elif fit is not None and written is None:
        log += [
            f"{text} (--allow-missing keeps the joint file's own); {nothing}" for text in fit.refused.values()
        ]
        status = 1
    return Outcome(report_lines(result), as_mapping(result), log, written, status)


def _efficiency_result(
    joint: Joint, number: int, runs: list[RunFile], options: argparse.Namespace
) -> EfficiencyResult:
    """Return channels, plateaus, points and fits; findings end it. Raises PlateauError and RunTableError."""
    result = EfficiencyResult(
        joint.name,
        number,
        {run.name: run.sha256 for run in runs},
        current_min_a=options.min_current or default_current_min(joint),
        findings=tuple(channel_findings(runs, number, joint)),
    )
    if result.findings:
        return result
    plateaus = plateaus_of(runs, number, joint, options.min_hold)
    points, left_out = eta_points(plateaus, joint, result.current_min_a)
    found = efficiency_findings(points, joint)
    fits: list[EfficiencyFit] = []
    if not found:
        kinds = (
            (options.convention, options.weighted),
            (options.convention, not options.weighted),
            (CONVENTIONS[0], options.weighted),
        )
        fits = [fit_efficiency(points, c, joint, weighted=w) for c, w in dict.fromkeys(kinds)]
    return replace(
        result, points=tuple(points), left_out=tuple(left_out), fits=tuple(fits), findings=tuple(found)
    )


# Friction ----------------------------------------------------------------------------------------------


def _fit_friction(joint: Joint, number: int, runs: list[RunFile], options: argparse.Namespace) -> Outcome:
    found = channel_findings(runs, number, joint)
    if found:
        lines = [f"{item.kind}: {item.text}" for item in found]
        return Outcome(lines, log=[f"{counted(len(found), 'finding')}, not fitted"], status=3)
    plateaus = plateaus_of(runs, number, joint, options.min_hold)
    chosen = no_load(plateaus, joint, options.min_current or default_current_min(joint))
    fit = fit_no_load(chosen, joint)
    mapping = {
        "schema": "jtq.friction/1",
        "joint": joint.name,
        "number": number,
        "friction": fit.friction,
        "terms": fit.terms,
        "rmse_nm": fit.rmse_nm,
        "warnings": fit.warnings,
        "plateaus": chosen,
    }
    new = replace(joint, friction=fit.friction)
    new = _fitted(new, "friction", runs, "friction", mean_temperature(chosen), plateaus=fit.plateaus)
    lines = [f"{joint.name} (j{number}): friction at no load", *fit.lines()]
    return Outcome(lines, plain_values(mapping), joint=new)


# Losses ------------------------------------------------------------------------------------------------

ONE_ENCODER: Final = (
    "the runs have one encoder of this joint: no torsion is fitted, sigma is that of motor current less loss"
)
FEW_RUNS: Final = (
    f"up to {MOST_RUNS} runs: what they do not determine stays near the joint file and widens sigma "
    "(docs/results.md)"
)


def _fit_losses(joint: Joint, number: int, runs: list[RunFile], options: argparse.Namespace) -> Outcome:
    found = channel_findings(runs, number, joint)
    if found:
        return Outcome(log=[item.text for item in found], status=3)
    two = two_encoders(runs, number, joint)
    signals = signals_of_runs(runs, number, joint)
    if not any(number in run.known_loads for run in runs):
        return _losses(joint, signals, runs, [], two=two, few=not two and len(runs) <= MOST_RUNS)
    try:
        teacher = fit_teacher(signals, joint, two_encoders=two)
        if refusal := teacher.refusal(joint):
            return Outcome(log=[refusal], status=3)
        signals = [teacher.complete(run) for run in signals]
        arm = teacher.lines(joint, two_encoders=two)
        two = two and teacher.stiffness_share <= STIFFNESS_KNOWN
        few = (not two and len(runs) <= MOST_RUNS) or teacher.load_nm < WEIGHT * joint.rated_torque_nm
        return _losses(joint, signals, runs, arm, two=two, few=few)
    except (LossFitError, TorsionError) as error:
        return Outcome(log=[str(error)], status=3)


def _losses(
    joint: Joint,
    signals: Sequence[RunSignals],
    runs: Sequence[RunFile],
    arm: Sequence[str],
    *,
    two: bool,
    few: bool,
) -> Outcome:
    """Return the outcome of a fit to signals with a teacher. arm: report on known loads; few: with priors of few runs."""
    if few:
        found = fit_few_runs(signals, joint)
        lines, log = _few_lines(found), [FEW_RUNS] if arm else [ONE_ENCODER, FEW_RUNS]
        new, unseen = found.joint, [found.held_out_nm]
        sigma_per_k, samples = PER_K_PRIOR[1], found.samples
        notes: dict[str, Any] = {"few_runs": found.lines(), "rotor_inertia_kgm2": "fitted, too"}
        more = {
            "effective_samples": found.effective,
            "terms": [asdict(term) for term in found.terms],
            "rotor_inertia_kgm2": new.rotor_inertia_kgm2,
        }
    else:
        fit = fit_fused(signals, joint, two_encoders=two)
        lines, log = _fused_lines(joint, fit), [] if two or arm else [ONE_ENCODER]
        new, unseen = replace(joint, fused=fit.fused), list(fit.held_out_rmse_nm)
        sigma_per_k, samples = fit.loss.viscous_per_k_sigma, fit.loss.samples
        notes, more = {}, {}
    assert new.fused is not None
    mapping = {
        "schema": "jtq.fit_losses/1",
        "unseen_rmse_nm": unseen,
        "samples": samples,
        "viscous_per_k_sigma": sigma_per_k,
        **more,
        "fused": new.fused.to_mapping(),
    }
    notes = {"unseen_rmse_nm": round(_together(unseen), 4), **notes}
    notes |= {"known_loads": list(arm)} if arm else {}
    new = _fitted(new, "fused", runs, "losses", new.fused.loss.temperature_c, **notes)
    return Outcome([*lines, *(f"  {line}" for line in arm)], mapping, log, new)


def _few_lines(fit: FewRunsFit) -> list[str]:
    sigma = fit.fused.sigma
    scale = "/".join(f"{each:.2f}" for each in sigma.scale)
    return [
        f"{fit.joint.name}: few runs, one encoder",
        *(f"  {line}" for line in fit.lines()),
        f"  sigma of the torque on another day {sigma.current_nm:.2f} Nm, {sigma.viscous_nms_per_rad:.2f} Nms/rad, "
        f"{100 * sigma.load:.1f} % of load, times {scale} by quadrant ({', '.join(QUADRANTS)})",
    ]


def _together(rmse_nm: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(rmse_nm))))


def _fused_lines(joint: Joint, fit: FusedFit) -> list[str]:
    fused, rmse, worst = fit.fused, _together(fit.held_out_rmse_nm), max(fit.held_out_rmse_nm)
    sigma, torsion, loss, share = fused.sigma, fused.torsion, fused.loss, 100 * rmse / joint.rated_torque_nm
    lines = [
        f"{joint.name}: physics on held-out runs: RMSE {rmse:.3f} Nm ({share:.2f} % of rated), worst run {worst:.3f} Nm",
        f"  loss: {fit.loss.samples} samples, viscous friction falls {100 * loss.viscous_per_k:.1f} "
        f"+- {196 * fit.loss.viscous_per_k_sigma:.1f} % per kelvin",
        f"  sigma of the current path {sigma.current_nm:.2f} Nm, {sigma.viscous_nms_per_rad:.2f} Nms/rad, "
        f"{100 * sigma.load:.1f} % of load",
    ]
    if torsion is None:
        return lines
    lines[-1] += (
        f"; of the torsion {sigma.torsion_nm:.2f} Nm; of the sensor's offset {sigma.reference_nm:.2f} Nm"
    )
    two, four, *_ = np.hypot(torsion.cos_rad, torsion.sin_rad) * 1e6
    lines.append(
        f"  stiffness {torsion.stiffness_nm_per_rad:.0f} Nm/rad (file: {joint.stiffness_nm_per_rad:.0f}), kinematic "
        f"error {two:.0f} urad at 2 per motor revolution, {four:.0f} at 4"
    )
    if (found := fused.agreement) is not None:
        apart = f"{found.slow_nm:.2f} Nm slowly and {found.fast_nm:.2f} Nm over the motor's turn"
        lines.append(f"  current and torsion differ by up to {apart}; sigma grows beyond")
    if (zeros := fused.zeros) is not None:
        spread = f"{1e6 * zeros.spread_rad:.0f} urad, {zeros.spread_nm:.2f} Nm, from day to day"
        lines.append(f"  the link encoder's offset differs by {spread}; with track_zeros it is learned")
    if fused.standstill is None:
        lines.append("  too few runs come to rest to calibrate the interval there: 3 standard deviations")
    else:
        rest = f"{fused.standstill.sigmas:.2f} standard deviations and what slip and friction leave open"
        lines.append(f"  at rest the interval is {rest}")
    if (tracking := fused.tracking) is not None:
        lines.append(
            f"  with the torsion tracked, an estimate without delay: {tracking.sigma_nm:.2f} Nm and "
            f"{tracking.viscous_nms_per_rad:.2f} Nms/rad more, added as squares, the latter bent above "
            f"{tracking.saturation_rad_s:g} rad/s"
        )
    return lines


KINDS: Final = {
    "efficiency": Kind(
        "efficiency: Eq. (8) per quadrant, from plateaus",
        "Fit the paper's Eq. (8) to the plateaus of measured runs, quadrant by quadrant.",
        "  jtq fit efficiency campaigns/efficiency --joint joint1.yaml --out joint1.fitted.yaml --plot fig6.png\n"
        "  jtq fit efficiency runs/*.csv --joint joint2.yaml --number 2 --json",
        _efficiency_options,
        _fit_efficiency,
    ),
    "friction": Kind(
        "Coulomb and viscous friction at no load, from plateaus",
        "Fit Coulomb and viscous friction to the plateaus at no load (motor current or joint torque near zero).",
        "  jtq fit friction campaigns/efficiency --joint joint1.yaml --out joint1.friction.yaml",
        _plateau_options,
        _fit_friction,
    ),
    "losses": Kind(
        "additive loss over load and velocity, from whole runs",
        "Additive loss over load, speed, direction and temperature; torsion; sigma.",
        "  jtq fit losses campaigns/excitation --joint joint1.yaml --out joint1.fused.yaml\n"
        "  jtq fit losses runs/light runs/heavy --joint joint1.yaml --columns payloads.yaml --out joint1.fused.yaml\n"
        "The runs must excite load, speed and both directions; `jtq campaign excitation` records them.\n"
        f"With one encoder one to {MOST_RUNS} runs will do, with a wider sigma.",
        lambda parser: None,
        _fit_losses,
    ),
}


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
