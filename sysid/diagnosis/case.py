"""The case of a diagnosis: its runs, the statistics by which effects are judged, and the effects fitted to the runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.current_zero import unpowered_columns, with_readings
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.evidence import RELEVANT
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS, Mixed
from jtqd.sysid.diagnosis.noise import Noise, noise_model, run_sums
from jtqd.sysid.diagnosis.refine import Refined, contributions, present_effects, refine, set_torsions
from jtqd.sysid.diagnosis.regressors import EffectCandidate, RunData, column_moments
from jtqd.sysid.diagnosis.search import Hypothesis, Search
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.unexplained import (
    Unexplained,
    events_left,
    held_energies_nm2,
    held_nm,
    unexplained_residual,
)

_PASSES: Final = 2


@dataclass(frozen=True)
class Fit:
    """A set of effects with refined parameters."""

    hypothesis: Hypothesis
    refined: Refined

    @property
    def chosen(self) -> tuple[EffectCandidate, ...]:
        """The effects, in the order of `refined.present`."""
        return self.hypothesis.chosen


@dataclass(frozen=True)
class Case:
    """Runs, their noise, the library's search on them; relevance: part of the rated torque, rms over a run, from which what
    effects leave matters.
    """

    dataset: Dataset
    noise: Noise
    search: Search
    relevance: float

    @property
    def few(self) -> bool:
        """Whether what is named must hold on each held-out run (`leave_one_out`)."""
        return self.search.mixed.runs < ENOUGH_RUNS

    @property
    def limits(self) -> dict[Channel, float]:
        """Rms from which the unexplained residual matters, per channel [Nm]."""
        rated = {n: joint.rated_torque_nm for n, joint in self.dataset.joints.items()}
        return {c: self.relevance * rated[c.joint] for c in self.dataset.runs[0].channels}

    def without_recording(self, number: int) -> Case:
        """Return the case of the other recordings, with the noise of all of them."""
        others = self.dataset.without_recording(number)
        return Case(others, self.noise, self.search.without_run(number), self.relevance)

    def fit(self, hypothesis: Hypothesis) -> Fit:
        """Return a set of effects with refined parameters; the signals then have the torsion that it implies."""
        return Fit(hypothesis, refine(self.dataset, present_effects(hypothesis), self.noise))

    def refit(self, fit: Fit, chosen: Sequence[EffectCandidate]) -> Fit:
        """Return the fit of other effects, begun at the variances of a fit."""
        return self.fit(self.search.hypothesis(chosen, fit.hypothesis.model))

    def rms_nm(self, fit: Fit) -> list[dict[Channel, float]]:
        """Return per effect the rms of its contribution in each channel, over valid bins [Nm]; the signals then have the
        torsion of this fit.
        """
        set_torsions(self.dataset, fit.refined.present)
        out = []
        for present in fit.refined.present:
            found = {c: np.concatenate(parts) for c, parts in contributions(self.dataset, present).items()}
            out.append({c: float(np.sqrt(np.mean(x * x))) for c, x in found.items() if len(x)})
        return out

    def energies_nm2(self, fit: Fit) -> list[float]:
        """Return the energy that each effect explains, summed over channels [Nm^2]."""
        return [sum(r * r for r in rms.values()) for rms in self.rms_nm(fit)]

    def unexplained(self, fit: Fit) -> Unexplained:
        """Return what the effects leave over."""
        return unexplained_residual(self.dataset, fit.refined, self.noise)

    def held_nm(self, fit: Fit) -> dict[Channel, float]:
        """Return what the samples of held channels are off by beside the effects (`unexplained.held_nm`)."""
        return held_nm(self.dataset, fit.refined)

    def held_energies_nm2(self, fit: Fit) -> dict[Channel, float]:
        """Return the same as energy over all runs (`unexplained.held_energies_nm2`)."""
        return held_energies_nm2(self.dataset, fit.refined)


def search_case(dataset: Dataset, relevance: float) -> tuple[Case, Fit]:
    """Return a dataset with noise and search, and the fit of what the search finds; again without the events that no effect
    makes: they shall bend none.
    """
    case, fit = _searched(dataset, relevance)
    events = events_left(dataset, fit.refined, case.noise)
    return _searched(dataset.without_events(events), relevance) if events else (case, fit)


def _searched(dataset: Dataset, relevance: float) -> tuple[Case, Fit]:
    noise, search, best = _noise_and_search(dataset)
    case = Case(dataset, noise, search, relevance)
    return case, case.fit(best)


def _noise_and_search(dataset: Dataset) -> tuple[Noise, Search, Hypothesis]:
    """Return noise model and best hypothesis: the noise first from what nothing explains, then from what the best
    hypothesis leaves, which is more by what the many columns of the first have fitted of the noise itself.
    """
    runs, candidates = dataset.runs, dataset.candidates
    columns = candidates[-1].columns.stop if candidates else 0
    groups = dataset.families
    sigma = np.array([g.sigma for g in groups])
    moments = column_moments(runs, columns)
    unpowered = unpowered_columns(candidates, dataset.joints)
    least_nm = RELEVANT * dataset.rated_torque_nm
    residuals = dataset.unexplained
    for k in range(_PASSES):
        noise = noise_model(runs, residuals, dataset.step_s)
        sums = [run_sums(run, noise, columns, len(groups)) for run in runs]
        sums = with_readings(sums, dataset.readings, unpowered)
        mixed = Mixed(sums, columns, sigma, dataset.pieces)
        effective = mixed.rows / noise.inflation
        search = Search(
            mixed, candidates, effective, moments, least_nm, readings=dataset.readings, unpowered=unpowered
        )
        best = search.confirmed()
        if k + 1 < _PASSES:
            residuals = {c: _unexplained(runs, best, c) for c in residuals}
    return noise, search, best


def _unexplained(runs: Sequence[RunData], best: Hypothesis, channel: Channel) -> list[FloatArray]:
    """Return the residual less the chosen effects and each run's own changes [n], NaN where not valid."""
    out = []
    columns = {c: float(b) for c, b in zip(best.model.columns, best.model.beta, strict=True)}
    for run, u in zip(runs, best.model.nuisances, strict=True):
        if channel not in run.channels:
            continue
        d = run.channels[channel]
        weights = np.array([columns.get(int(k), 0.0) for k in d.index])
        rest = d.residual - d.regressors @ weights - d.nuisances @ u[d.families]
        out.append(np.where(d.valid, rest, np.nan))
    return out
