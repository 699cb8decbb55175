"""One set of runs of a bench, with what is hidden in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

Array = np.ndarray
Columns = dict[str, Array]
"""Columns [n] of one run by the names of a run table, `time_s`, `j1.current_a`, ..."""

SENSOR = "sensor"


@dataclass(frozen=True)
class Hidden:
    """What is to be hidden: an effect of the library, or a kind that is in none; joint: 1, 2 or "sensor".

    size: of the leading parameter, relative to the joint as `units.Unit` says; ignored for a foreign kind. variant: of an
    effect that has some (`Bench.variants`): what is visible of them differs, so their sizes do.
    """

    name: str
    joint: int | str
    size: float = 0.0
    variant: str = ""


@dataclass(frozen=True)
class Set:
    """runs: columns of each; joints: nominal joint files as mappings; truth: {name, joint, parameters, size} of each hidden
    effect, with `places` for a foreign kind: where it is right to look.
    """

    runs: Sequence[Columns]
    joints: Mapping[int, Mapping[str, Any]]
    truth: Sequence[Mapping[str, Any]]


class Bench(Protocol):
    """What the campaign needs of a bench.

    foreign: kinds that are in no library. real: with nothing hidden there may still be something in its runs: every set is
    judged beside the set with nothing hidden of the same seed.
    """

    name: str
    real: bool
    effects: Sequence[str]
    foreign: Sequence[str]

    def draw(self, seed: int, hidden: Sequence[Hidden] = (), *, quiet: bool = False) -> Set:
        """Return the set of this seed: same joints, motions, noise and changes from run to run whatever is hidden.

        quiet: without noise, quantisation and changes from run to run.
        """

    def unseen(self) -> Bench:
        """Return the bench with what its joint files leave in runs that they were not fitted to; itself if to none."""

    def places(self, name: str) -> Sequence[int | str]:
        """Return where an effect can be: at joints, or at the sensor."""

    def variants(self, name: str) -> Sequence[str]:
        """Return the variants of an effect, one empty text where it has none."""
