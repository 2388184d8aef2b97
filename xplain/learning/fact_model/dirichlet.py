"""A Dirichlet-process mixture of labelers: as many types as the labels speak for.

The labelers are those of :mod:`xplain.learning.fact_model.model`; the process says how observers
share them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, Range, TooLargeError, checks
from xplain.learning.answer_classes import answer_classes
from xplain.learning.answer_model import AnswerModel, CellAnswers, learned
from xplain.learning.clustering import Clustering, KnowsFactSets, shares_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.fact_model.gibbs import Chain, sample
from xplain.learning.fact_model.model import (
    NOISE,
    ChainState,
    Prior,
    SortedLabels,
    facts_that_matter,
)
from xplain.learning.fact_model.resample_transitions import WIDE
from xplain.learning.labelers import LabelerTrainer
from xplain.randomness import derived_seed, stream

log = logging.getLogger(__name__)

FEWEST_SWEEPS = 20
MANY = 38
"""Messages of which there are too many sets of four."""
MAX_SUBSETS = 1 << 15
"""Fact sets S that may matter at a transition; all are weighed in every sweep."""


@checks("clusterer")
@dataclass(frozen=True)
class DirichletMixture:
    """Finds types by Gibbs sampling; the state of the highest joint probability is the answer.

    Attributes:
        concentration: α > 0 of the Chinese restaurant process; more makes new types likelier.
        depth: facts that may matter together at one transition; None: 5, or 4 where there are
            more than 12 messages, or so many observers that chains stop early (``updates``):
            among more sets of facts they have not settled by then; 3 beyond 38 messages.
        chains: independent runs; half start from one type, half from types at random.
        sweeps: of each chain, the first half of them heated. Large data need few:
        updates: a chain stops at this many updates of an observer (but makes 20 sweeps).
        heat: initial temperature.
        jobs: chains run at a time (threads); no result depends on it.
    """

    concentration: Positive = 1.0
    depth: Count | None = None
    chains: Count = 4
    sweeps: Annotated[int, Range(FEWEST_SWEEPS)] = 100
    updates: Count = 300_000
    heat: Annotated[float, Range(1)] = 4.0
    jobs: int = 1

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """Types, what each needs to be told, and the posterior over their number.

        Where nobody was told anything, types are classes of answers
        (:mod:`xplain.learning.answer_classes`). A trainer that knows what people might
        hold wrong finds the types itself: its hypotheses take the place of the prior over which
        facts matter where.

        Raises:
            TooLargeError: ``depth`` is too large for so many messages.
        """
        seed = derived_seed(seed, "clusterer")
        if isinstance(trainer, KnowsFactSets):
            known = trainer.find_types(dataset, self.concentration)
            if known is not None:
                return known
        if dataset.message_set.any():
            found = self._sampled(dataset, seed)
        else:
            found = answer_classes(dataset, self.concentration, self.chains, seed)
        assert found.posterior is not None
        share = 100 * found.posterior.get(found.n_types, 0.0)
        types = "%d user types by the rule posterior: %.0f%% of the samples have as many"
        log.info(types, found.n_types, share)
        return found

    def _sampled(self, dataset: Dataset, seed: int) -> Clustering:
        """By fact sets, of labels for which somebody was told something."""
        from joblib import Parallel, delayed

        observers, n = len(dataset.observers), dataset.n_messages
        long = observers * self.sweeps <= self.updates
        usual = 5 if n <= WIDE and long else 4 if n <= MANY else 3
        depth = min(self.depth or usual, n)
        if n**depth > 64 * MAX_SUBSETS:
            raise TooLargeError(
                f"clusterer.depth={depth}: too many sets of {n} messages; use a smaller depth"
            )
        answers, prior = SortedLabels.of(dataset), Prior.of(n, depth)
        sweeps = min(self.sweeps, max(self.updates // observers, FEWEST_SWEEPS))
        chains: list[Chain] = Parallel(n_jobs=self.jobs, prefer="threads")(
            delayed(sample)(
                answers,
                prior,
                self.concentration,
                self._first(observers, n, chain, seed),
                sweeps,
                self.heat,
                stream(seed, "dirichlet", chain),
            )
            for chain in range(self.chains)
        )
        best = max(chains, key=lambda chain: chain.score).best
        return Clustering.by_facts(
            best.facts & facts_that_matter(prior, best),
            "posterior",
            posterior=shares_of(np.concatenate([chain.types for chain in chains])),
            answers=_errors(dataset, prior, best),
        )

    def _first(self, observers: int, n: int, chain: int, seed: int) -> NDArray[np.int64]:
        everything = np.full(observers, (1 << n) - 1, dtype=np.int64)
        if chain % 2 == 0:
            return everything
        return stream(seed, "dirichlet", "first", chain).integers(0, 1 << n, observers)


def _errors(dataset: Dataset, prior: Prior, state: ChainState) -> AnswerModel:
    """Slips, guesses and error rates, were the cells of all answers those of ``state``.

    The sampler itself has one rate of errors a transition: an observer's own would make labels of a
    cell differ in weight, where its tables know their difference alone.
    """
    held = state.facts[dataset.observer] & ~dataset.message_set
    matters = held & prior.members[state.subset[dataset.transition]]
    both = np.stack([dataset.transition, matters])
    cells, cell = np.unique(both, axis=1, return_inverse=True)
    label = dataset.label.astype(np.int64)
    about = CellAnswers(cell.ravel(), dataset.transition, dataset.observer, label)
    wrong = float(np.exp(state.log_noise) @ NOISE)
    # How many cells are 1 is seen in the answers: where few answers share a cell, a share that is
    # too low would pass for guesses.
    kind = (matters > 0).astype(np.int64)
    ones = np.bincount(kind, label, 2) / np.bincount(kind, minlength=2).clip(1)
    one = ((ones - wrong) / (1 - 2 * wrong)).clip(0.02, 0.98)[(cells[1] > 0).astype(np.int64)]
    return learned(about, one, len(dataset.features), len(dataset.observers), wrong)
