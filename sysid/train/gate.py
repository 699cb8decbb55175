"""Whether a network is worth its risk: judged on runs left out, with a share that none of them had a say in. Pure."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

LEAST_GAIN: Final = 0.30
"""Of the error (RMSE) of physics that a network takes off."""
MOST_WORSE: Final = 0.02
"""Of the runs that are worse with it than by physics alone."""


@dataclass(frozen=True)
class Gate:
    """What a network has done on runs left out.

    Attributes:
        network_rmse_nm, physics_rmse_nm: over all runs, each of the same weight.
        runs, worse: how many there were, and how many were worse with it.
        share: of its correction that the network is written with, 0 to 1.
    """

    network_rmse_nm: float
    physics_rmse_nm: float
    runs: int
    worse: int
    share: float = 1.0

    @property
    def gain(self) -> float:
        """Return the part of the error of physics that the network takes off; below 0: it adds to it."""
        return 1.0 - self.network_rmse_nm / self.physics_rmse_nm if self.physics_rmse_nm > 0.0 else 0.0

    @property
    def passed(self) -> bool:
        """Return whether it may be used: not with the share 0, which is no network, however the runs were judged."""
        return self._earned and self.share > 0.0

    @property
    def _earned(self) -> bool:
        return self.gain >= LEAST_GAIN and self.worse <= MOST_WORSE * self.runs

    @property
    def text(self) -> str:
        """Return the verdict with its numbers, and what is expected."""
        return (
            f"on {self.runs} runs left out it takes {100 * self.gain:.1f} % off the error of physics "
            f"(RMSE {self.physics_rmse_nm:.3f} -> {self.network_rmse_nm:.3f} Nm; "
            f"expected at least {100 * LEAST_GAIN:.0f} %) "
            f"and is worse in {self.worse} (expected at most {100 * MOST_WORSE:.0f} %)"
            + (
                "; but no share of it is without harm to all of them"
                if self._earned and not self.passed
                else ""
            )
        )

    def to_mapping(self) -> dict[str, Any]:
        """Plain values for JSON and for the metadata of a network."""
        return {
            "passed": self.passed,
            "gain": self.gain,
            "network_rmse_nm": self.network_rmse_nm,
            "physics_rmse_nm": self.physics_rmse_nm,
            "runs": self.runs,
            "worse": self.worse,
        }


def judge(scores: Collection[tuple[float, float]], share: float = 1.0) -> Gate:
    """Return the verdict on the MSE [Nm²] of each run left out: (with the network, physics alone).

    share: of its correction that the network is to be written with; a run is judged with one that it had no say in. A
    network that changes nothing takes nothing off, and is worse nowhere. Raises ValueError without a run.
    """
    if not scores:
        raise ValueError("found no run left out, expected at least one")
    table = np.array(list(scores), np.float64)
    network, physics = np.sqrt(table.mean(axis=0)).tolist()
    return Gate(network, physics, len(table), int((table[:, 0] > table[:, 1]).sum()), share)
