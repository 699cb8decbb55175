"""`python -m validation [STUDY [OPTION ...]]`: list the studies, or run one."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Final

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: one process per core is faster
os.environ.setdefault("OMP_NUM_THREADS", "1")

STUDIES: Final = {
    "frozen": ("validation.frozen", "results that a restructuring must not change, beside the stored ones"),
    "goals": ("validation.goals.__main__", "three plants: error and interval against the true torque"),
    "sources": ("validation.goals.sources", "what the error of the estimate is made of on a bench"),
    "other_plant": ("validation.goals.other_plant", "joint files of another plant: how soon it is flagged"),
    "kinova": ("validation.goals.kinova", "the measured arm: fitted to one run, judged on the other"),
    "few_runs": ("validation.goals.few_runs", "two short runs of one encoder on the three plants"),
    "few_runs_mujoco": ("validation.worlds.few_runs", "two short runs of one encoder in MuJoCo"),
    "measured": ("validation.measured.command", "the measured arm: joint files as shipped and fitted"),
    "reproduce": ("validation.reproduce", "all campaigns, fits, training and evaluation"),
    "trials": ("validation.hidden.campaign", "diagnosis: hidden effects of the project's generator"),
    "benches": ("validation.worlds.campaign", "diagnosis: hidden effects in MuJoCo and in measured runs"),
    "oracle": ("validation.worlds.oracle", "size from which an effect is visible in a bench"),
    "smallest": ("validation.worlds.smallest", "size from which the diagnosis reports each effect"),
    "more_data": ("validation.worlds.more_data", "what one more run changes in the findings"),
}
"""Study -> (module, one line of help)."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study; exit status 0 done, 1 failure, 2 usage, 3 done and targets missed, 130 Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print("usage: python -m validation STUDY [OPTION ...]\n")
        width = max(map(len, STUDIES))
        print("\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in STUDIES.items()))
        return 0
    if words[0] not in STUDIES:
        print(f"validation: found {words[0]!r}, expected one of {', '.join(STUDIES)}", file=sys.stderr)
        return 2
    try:
        status: int = importlib.import_module(STUDIES[words[0]][0]).main(words[1:])
    except KeyboardInterrupt:
        return 130
    return status


if __name__ == "__main__":
    sys.exit(main())
