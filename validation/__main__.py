"""`python -m validation [STUDY [OPTION ...]]`: list the studies, or run one and print its tables."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: one process per core is faster
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from jtqd.estimator.command_line import check_output
from validation.study import UsageError, json_of, text_of

STUDIES: Final = {
    "goals": ("validation.goals.goals", "four plants: error and interval against the true torque"),
    "current_path": (
        "validation.current_path.study",
        "a network of the current path: one encoder on four plants",
    ),
    "changed": (
        "validation.current_path.changed",
        "one thing changed after the fit: with a network, and without",
    ),
    "payloads": (
        "validation.goals.payloads",
        "fitted from two known payloads, without a torque sensor, against fitted with one",
    ),
    "expect": ("validation.goals.expect", "error and interval to expect of a joint, from its data sheet"),
    "sources": ("validation.goals.sources", "what the error of the estimate is made of on a bench"),
    "other_plant": ("validation.goals.other_plant", "joint files of another plant: how soon it is flagged"),
    "two_runs": (
        "validation.goals.two_runs",
        "one encoder, two short runs: fitted to one, judged on the other",
    ),
    "measured": (
        "validation.measured",
        "the measured arm: joint files as shipped and fitted, offline or on a bus",
    ),
    "external_torque": ("validation.arm.study", "external torque of a foreign arm: pushes, clamps, payloads"),
    "reproduce": ("validation.reproduce", "all campaigns, fits, training and evaluation"),
    "trials": ("validation.diagnosis.trials", "diagnosis: effects hidden by the project's generator"),
    "benches": ("validation.diagnosis.benches", "diagnosis: effects hidden in MuJoCo and in measured runs"),
    "oracle": ("validation.diagnosis.oracle", "size from which an effect is visible, or would be reported"),
    "more_data": ("validation.diagnosis.more_data", "diagnosis: what one more run changes"),
    "open_questions": (
        "validation.diagnosis.open_questions",
        "diagnosis: open questions of other projects, rebuilt in MuJoCo",
    ),
    "person": (
        "validation.diagnosis.person",
        "diagnosis: data as a person has them, several wrong values at once",
    ),
    "frozen": ("validation.frozen", "results that a restructuring must not change, beside the stored ones"),
}
"""Study -> (module, one line of help)."""
DONE, FAILED, USAGE, MISSED, INTERRUPTED = 0, 1, 2, 3, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study; exit status 0 done, 1 failure, 2 usage, 3 done and targets missed, 130 Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, STUDIES))
        studies = "\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in STUDIES.items())
        print(f"usage: python -m validation STUDY [--json FILE] [OPTION ...]\n\n{studies}")
        return DONE
    name = words[0]
    if name not in STUDIES:
        print(f"validation: found {name!r}, expected one of {', '.join(STUDIES)}", file=sys.stderr)
        return USAGE
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends what a study has started, as Ctrl-C
    study = importlib.import_module(STUDIES[name][0])
    parser = argparse.ArgumentParser(
        prog=f"python -m validation {name}",
        description=study.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    study.options(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write tables and values as JSON")
    options = parser.parse_args(words[1:])
    try:
        if options.json is not None:
            check_output(options.json)
        report = study.run(options)
        if options.json is not None:
            options.json.write_bytes(json_of(name, report))
    except KeyboardInterrupt:
        return INTERRUPTED
    except UsageError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return USAGE
    except (ValueError, RuntimeError, OSError, ModuleNotFoundError) as error:
        text = (
            f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
        )
        print(f"{name}: {text}", file=sys.stderr)
        return FAILED
    print(text_of(report))
    return DONE if report.reached else MISSED


if __name__ == "__main__":
    sys.exit(main())
