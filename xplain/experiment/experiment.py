"""One whole run: the two halves of the method, and the certificates of the second half.

Components ── Prepared ── Records ── certificates
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from xplain.experiment.cache import EpisodeCache, load_or_prepare
from xplain.experiment.certificates import Certify
from xplain.experiment.explanations import (
    Costs,
    evaluate,
    same_problems,
    with_true_labels,
    without_tables,
)
from xplain.experiment.pipeline import Components, PreparedData, prepare, with_others
from xplain.experiment.progress import Progress
from xplain.explanation.belief import BeliefUpdate
from xplain.interaction.explainees import Explainee
from xplain.interaction.metrics import Record
from xplain.solvers.base import Solver
from xplain.solvers.greedy import Conformant, KnownType
from xplain.solvers.simple import SayAll


@dataclass(frozen=True)
class Experiment:
    """An experiment: everything that one run needs.

    Attributes:
        components: makes the components that decide data, types and traces. It is called only if
            the cache lacks the result, because importing their classifiers takes long.
        costs: λ and the other costs.
        solver, belief, explainee, certify: chosen in the configuration.
        seed: seed of every stream.
    """

    components: Callable[[], Components]
    costs: Costs
    solver: Solver
    belief: BeliefUpdate
    explainee: Explainee
    certify: Certify
    seed: int

    def prepare(self, cache: Path | None, key: str, progress: Progress) -> PreparedData:
        """Runs the first half: observers label transitions, types and labelers are learned, traces
        are drawn. Caches the result in the folder ``cache`` by its ``key``. Without a folder,
        always computes the result."""
        with progress.stage("data, user types and labelers"):
            return load_or_prepare(cache, key, lambda: prepare(self.components(), progress))

    def explain_cases(
        self, prepared: PreparedData, cache: EpisodeCache, progress: Progress
    ) -> tuple[PreparedData, list[Record]]:
        """Runs the second half: the solver and its references explain each trace to a user of each
        type. Returns the traces with their users, and the records.

        Args:
            prepared: result of the first half.
            cache: shared episodes of other solvers' and learners' runs.
            progress: receives the progress.
        """
        references: dict[str, Solver] = {"clairvoyant": KnownType("labels")}
        stranger = not self.explainee.as_observed
        if stranger:
            prepared = with_others(prepared, self.components(), self.explainee)
        elif all(case.perfect is not None for case in prepared.cases):
            references["oracle"] = KnownType("type")

        def explain(known: PreparedData, solvers: dict[str, Solver], what: str) -> list[Record]:
            rest = self.belief, self.explainee, self.seed, progress, what
            return evaluate(known, self.costs, solvers, *rest)

        truth = with_true_labels(prepared)
        habits = self.belief.habits(prepared.habits)
        seen = without_tables(truth, self.belief, oracle=True)
        records = cache.load_or_make(
            replace(seen, habits=habits),
            ("solver",),
            lambda: explain(seen, references, "references"),
        )
        # Some solvers do not plan with the learned types, and the true types of
        # strangers are unknown.
        true_labels: list[Record] = []
        if self.solver.knows == "types" and not stranger:
            known, name = without_tables(truth, self.belief, oracle=False), "true_labels"
            true_labels = cache.load_or_make(
                replace(known, habits=habits),
                (),
                lambda: explain(known, {name: self.solver}, "explaining, true labels known"),
            )
        if true_labels and same_problems(prepared, truth):  # nothing was learned
            own = [replace(record, solver="solver") for record in true_labels]
        else:
            own = explain(prepared, {"solver": self.solver}, "explaining")
        if self.belief.open:
            safe: dict[str, Solver] = {"say_all": SayAll(), "conformant": Conformant()}
            own += explain(prepared, safe, "references for people of no type")
        return prepared, [*own, *records, *true_labels]
