"""`jtq fit efficiency`: plateaus of the runs, eta by quadrant, Eq. (8), and a new joint file."""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

from estimator.checked import ConfigError
from estimator.parameters import CONVENTIONS, Joint
from estimator.run import RunTableError
from models.files import load_joint
from sim_can.run_files import RunError
from sysid.efficiency_findings import efficiency_findings, written_findings
from sysid.efficiency_fit import EfficiencyFit, default_current_min, eta_points, fit_efficiency
from sysid.efficiency_report import EfficiencyResult, as_mapping, report_lines
from sysid.fit_arguments import add_plateau_options, fit_parser, parse_fit, today
from sysid.fit_inputs import InputRun, channel_findings, joint_number, plateaus_of, read_runs
from sysid.joint_writer import with_fit, write_joint
from sysid.plateaus import PlateauError, PlateauRules

BY = "jtq fit efficiency"


def main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    options = parse_fit(_parser(), argv)
    if options.plot is not None and importlib.util.find_spec("matplotlib") is None:
        print(f"{BY}: --plot: matplotlib is not installed (it is in the extra 'train')", file=sys.stderr)
        return 1
    try:
        joint = load_joint(options.joint)
        runs = read_runs(options.runs, options.columns)
        number = joint_number(options.number, joint, runs)
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
            write_joint(options.out, written, f"Written by {BY} from {len(runs)} runs.")
            print(f"{BY}: wrote {options.out}", file=sys.stderr)
    except (ConfigError, RunError, RunTableError, PlateauError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    return 0


def analyse(joint: Joint, runs: list[InputRun], number: int, options: argparse.Namespace) -> EfficiencyResult:
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


def _parser() -> argparse.ArgumentParser:
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
        help="quadrants that cannot be fitted keep the joint file's own coefficients",
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture like Fig. 6 (png, svg, pdf)")
    return parser


def _new_joint(joint: Joint, result: EfficiencyResult, options: argparse.Namespace) -> Joint | None:
    """The joint with its new efficiency; None when a quadrant is refused and that was not allowed."""
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
        by=BY,
        runs=result.runs,
        date=today(),
        temperature_c=result.temperature_c,
        notes=notes,
    )


def _refuse(result: EfficiencyResult, options: argparse.Namespace) -> int:
    """Say on standard error why nothing was written."""
    nothing = f"nothing was written to {options.out}" if options.out is not None else "not fitted"
    if result.findings:
        count = len(result.findings)
        print(f"{BY}: {count} finding{'s' if count > 1 else ''}, {nothing}", file=sys.stderr)
        return 3
    for text in result.fits[0].refused.values():
        print(f"{BY}: {text} (--allow-missing keeps the joint file's own); {nothing}", file=sys.stderr)
    return 1


def _draw(joint: Joint, result: EfficiencyResult, path: Path) -> None:
    from sysid.efficiency_plot import draw_fit

    title = f"{joint.name}: measured efficiency and Eq. (8), convention {result.fits[0].convention}"
    try:
        draw_fit(result.points, result.fits[0], title, path)
    except ValueError as error:  # matplotlib's own: an ending that it does not know
        raise ConfigError(f"--plot {path}: {error}") from None
    print(f"{BY}: wrote {path}", file=sys.stderr)
