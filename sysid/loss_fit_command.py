"""`jtq fit losses`: additive loss, torsion and standard deviations from whole runs: section `fused` of a joint file."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.checked import ConfigError
from estimator.parameters import Joint
from estimator.run import RunTableError
from estimator.settings import EstimatorSettings
from models.files import load_joint
from sim_can.run_files import RunError
from sysid.fit_arguments import fit_parser, parse_fit, today
from sysid.fit_inputs import InputRun, channel_findings, joint_number, progress, read_runs
from sysid.fused_fit import FusedFit, fit_fused
from sysid.joint_writer import with_fit, write_joint
from sysid.loss_fit import LossFitError
from sysid.run_signals import RunSignals, run_signals
from sysid.torsion_fit import TorsionError

BY = "jtq fit losses"
_EXAMPLE = (
    "  jtq fit losses campaigns/excitation --joint joint1.yaml --out joint1.fused.yaml\n"
    "Runs that excite load, speed and both directions are needed: jtq campaign excitation records such."
)


def main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    options = parse_fit(
        fit_parser(
            "losses", "Additive loss over load, speed, direction and temperature; torsion; sigma.", _EXAMPLE
        ),
        argv,
    )
    try:
        joint = load_joint(options.joint)
        runs = read_runs(options.runs, options.columns)
        number = joint_number(options.number, joint, runs)
        findings = channel_findings(runs, number, joint)
        if findings:
            for finding in findings:
                print(f"{BY}: {finding.text}", file=sys.stderr)
            return 3
        fit = fit_fused(signals_of(runs, number, joint), joint.friction)
        written = _with_fused(joint, fit, runs)
        print(json.dumps(_mapping(fit), indent=1) if options.json else "\n".join(_lines(joint, fit)))
        if options.out is not None:
            write_joint(options.out, written, f"Written by {BY} from {len(runs)} runs.")
            print(f"{BY}: wrote {options.out}", file=sys.stderr)
    except (ConfigError, RunError, RunTableError, LossFitError, TorsionError, ValueError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    return 0


def signals_of(runs: list[InputRun], number: int, joint: Joint) -> list[RunSignals]:
    """Return what fits of the fused estimator see of one joint in all runs, with a progress bar on a terminal."""
    settings = EstimatorSettings(method="fused")
    return [
        run_signals(run.name, joint, settings, run.table.time_s, run.table.joint(number, joint.gear_ratio))
        for run in progress(runs, f"observing {joint.name}")
    ]


def _with_fused(joint: Joint, fit: FusedFit, runs: list[InputRun]) -> Joint:
    return with_fit(
        replace(joint, fused=fit.fused),
        "fused",
        by=BY,
        runs={Path(run.name).name: run.sha256 for run in runs},
        date=today(),
        temperature_c=fit.fused.loss.temperature_c,
        notes={"unseen_rmse_nm": round(_unseen(fit), 4)},
    )


def _unseen(fit: FusedFit) -> float:
    return float(np.sqrt(np.mean(np.square(fit.unseen_rmse_nm))))


def _mapping(fit: FusedFit) -> dict[str, object]:
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
        f"{joint.name}: physics on runs the fit had not seen: RMSE {_unseen(fit):.3f} Nm "
        f"({100 * _unseen(fit) / joint.rated_torque_nm:.2f} % of rated), worst run {max(fit.unseen_rmse_nm):.3f} Nm",
        f"  loss: {fit.loss.samples} samples, viscous friction falls {100 * loss.viscous_per_k:.1f} "
        f"+- {196 * fit.loss.viscous_per_k_sigma:.1f} % per kelvin",
        f"  sigma of the current path {sigma.current_nm:.2f} Nm, {sigma.viscous_nms_per_rad:.2f} Nms/rad, "
        f"{100 * sigma.load:.1f} % of load; of the torsion {sigma.torsion_nm:.2f} Nm; of the sensor's zero "
        f"{sigma.reference_nm:.2f} Nm",
    ]
    if torsion is not None:
        amplitude = np.hypot(torsion.cos_rad, torsion.sin_rad) * 1e6
        lines.append(
            f"  stiffness {torsion.stiffness_nm_per_rad:.0f} Nm/rad (file: {joint.stiffness_nm_per_rad:.0f}), kinematic "
            f"error {amplitude[0]:.0f} urad at 2 per motor revolution, {amplitude[1]:.0f} at 4"
        )
    return lines
