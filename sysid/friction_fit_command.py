"""`jtq fit friction`: Coulomb and viscous friction at no load, from plateaus, into a new joint file."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from estimator.checked import ConfigError
from estimator.parameters import Joint
from estimator.run import RunTableError
from models.files import load_joint
from sim_can.run_files import RunError
from sysid.efficiency_fit import default_current_min
from sysid.efficiency_report import plateau_mapping
from sysid.fit_arguments import add_plateau_options, fit_parser, parse_fit, today
from sysid.fit_inputs import channel_findings, joint_number, plateaus_of, read_runs
from sysid.friction_fit import FitError
from sysid.joint_writer import with_fit, write_joint
from sysid.no_load_friction import NoLoadFit, fit_no_load, no_load
from sysid.plateaus import Plateau, PlateauError, PlateauRules

BY = "jtq fit friction"


def main(argv: list[str]) -> int:
    """Fit and write; exit status 0 done, 1 failure, 2 usage, 3 findings (then nothing is written)."""
    parser = fit_parser(
        "friction",
        "Fit Coulomb and viscous friction to the plateaus at no load: motor current or joint torque next to zero.",
        "  jtq fit friction campaigns/efficiency --joint joint1.yaml --out joint1.friction.yaml",
    )
    add_plateau_options(parser)
    options = parse_fit(parser, argv)
    try:
        joint = load_joint(options.joint)
        runs = read_runs(options.runs, options.columns)
        number = joint_number(options.number, joint, runs)
        found = channel_findings(runs, number, joint)
        if found:
            for item in found:
                print(f"{item.kind}: {item.text}")
            print(f"{BY}: {len(found)} findings, not fitted", file=sys.stderr)
            return 3
        plateaus = plateaus_of(runs, number, joint, PlateauRules(shortest_s=options.min_hold))
        chosen = no_load(plateaus, joint, options.min_current or default_current_min(joint))
        fit = fit_no_load(chosen, joint)
        if options.json:
            print(json.dumps(_mapping(joint, number, fit, chosen), indent=1))
        else:
            print("\n".join([f"{joint.name} (j{number}): friction at no load", *fit.lines()]))
        if options.out is not None:
            temperatures = [p.temperature_c for p in chosen if math.isfinite(p.temperature_c)]
            new = with_fit(
                replace(joint, friction=fit.friction),
                "friction",
                by=BY,
                runs={run.name: run.sha256 for run in runs},
                date=today(),
                temperature_c=float(np.mean(temperatures)) if temperatures else math.nan,
                notes={"plateaus": fit.plateaus},
            )
            write_joint(options.out, new, f"Written by {BY} from {len(runs)} runs.")
            print(f"{BY}: wrote {options.out}", file=sys.stderr)
    except (ConfigError, RunError, RunTableError, PlateauError, FitError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    return 0


def _mapping(joint: Joint, number: int, fit: NoLoadFit, plateaus: Sequence[Plateau]) -> dict[str, Any]:
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
