"""Certificates of a run's explanation problems: bounds of the optimal value, the value of the
policy, and the value of knowing the type (all under the learned model)."""

import logging
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from xplain.errors import Count, Positive, Range, TooLargeError, Whole, checks
from xplain.experiment.explanations import Costs, problem_for, problem_of_types, trace_seed
from xplain.experiment.pipeline import PreparedData
from xplain.experiment.progress import SILENT, Progress
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.problem import Problem
from xplain.interaction.statistics import half_width
from xplain.solvers.base import Solver
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate
from xplain.solvers.hsvi import Effort

log = logging.getLogger(__name__)


@checks("certify")
@dataclass(frozen=True)
class Certify:
    """Work limits of the certificates; ``certify`` in conf/config.yaml gives the numbers.

    Attributes:
        traces: number of traces with certificates; 0 makes none.
        gap: the search for the optimum stops at this gap.
        nodes: maximum number of beliefs that the search expands for each trace.
        beliefs: a policy's value is exact if it reaches at most this number of beliefs.
        episodes: number of simulated episodes if the value is not exact.
        memory_gib: maximum memory of one certificate, the same as the solver's.
    """

    traces: Whole
    gap: Positive
    nodes: Count
    beliefs: Whole
    episodes: Annotated[int, Range(2)]
    memory_gib: Positive = 8.0

    def certificates(
        self,
        prepared: PreparedData,
        costs: Costs,
        solver: Solver,
        belief_update: BeliefUpdate,
        seed: int,
        progress: Progress = SILENT,
    ) -> dict[str, float]:
        """Computes figures of the explanation problems: means over the traces, under the learned
        model. Users of this model listen and answer as the belief update assumes. All values are
        expected discounted returns.

        The result contains

        - ``optimal_lower``, ``optimal_upper``: bounds of the optimal value;
        - ``known_type_value``: value of a policy that knows the type (and the users' knowledge, if
          users may miss or forget messages);
        - ``value_of_perfect_information_low`` and ``…_high``: bounds of ``known_type_value`` minus
          the optimal value;
        - ``policy_value``: the solver's value; ``policy_value_se``, its standard error;
          ``policy_value_low`` and ``…_high``, its 95 % interval; ``policy_value_exact``, the share
          of traces whose value is exact and not simulated;
        - ``policy_cost``: the policy's expected undiscounted cost;
        - ``price_of_approximation_low`` and ``…_high``: bounds of the optimal value minus the
          policy's value, at the ends of its 95 % interval;
        - ``traces``: number of traces with a certificate;
        - ``fresh_labels``: 0, only if the belief update does not assume independent labels.

        The figures of the policy are absent in two cases: the solver knows the user's type
        (docs/method.md, section 7), or the belief update does not assume independent labels. The
        bounds always assume them, and such a policy decides by another belief.

        A trace whose certificate would need more memory than allowed has no certificate.
        """
        rows, cases = [], prepared.cases[: self.traces]
        for index, case in progress.track(enumerate(cases), "certificates", len(cases)):
            problem = problem_of_types(prepared, case, costs, belief_update)
            own = None
            if belief_update.fresh_labels and solver.knows not in ("type", "labels"):
                own = problem_for(prepared, case, costs, solver, belief_update, 0)
            try:
                rows.append(self._certify(problem, own, solver, trace_seed(seed, index), progress))
            except TooLargeError as error:
                log.warning("no certificate of trace %d: %s", index, error)
        if not rows:
            return {}
        means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        if "policy_value_se" in means:
            errors = [row["policy_value_se"] for row in rows]
            means["policy_value_se"] = float(np.linalg.norm(errors)) / len(rows)
            margin = half_width(means["policy_value_se"], self.episodes - 1)
            means["policy_value_low"] = means["policy_value"] - margin
            means["policy_value_high"] = means["policy_value"] + margin
        if not belief_update.fresh_labels:
            means["fresh_labels"] = 0.0
        return means | {"traces": float(len(rows))}

    def _certify(
        self,
        problem: Problem,
        own: Problem | None,
        solver: Solver,
        seed: int,
        progress: Progress,
    ) -> dict[str, float]:
        """Computes the figures of one trace.

        Args:
            problem: the problem under the learned types.
            own: the problem that the solver plans for; None leaves out the figures of the policy.
            solver, seed: make the policy.
            progress: receives the progress.
        """
        with progress.stage("bounds of the optimum"):
            effort = Effort(gap=self.gap, nodes=self.nodes, memory_gib=self.memory_gib)
            found = bounds(problem, effort, lambda gap: progress.note(f"gap {gap:.4f} so far"))
        low, high = found.value_of_perfect_information
        figures = {
            "optimal_lower": found.lower,
            "optimal_upper": found.upper,
            "known_type_value": found.known_type,
            "value_of_perfect_information_low": low,
            "value_of_perfect_information_high": high,
        }
        if own is None:
            return figures
        # A policy for a one-type problem uses no belief. Its value for several types is its value
        # for the mixture of these types, if all types accept all messages.
        world = problem
        if own.n_types == 1 and problem.messages_land:
            with suppress(TooLargeError):  # without the mixture, the same value takes longer
                world = problem.mixture(problem.prior, own.type_names[0])
        with progress.stage("value of this policy"):
            worth = evaluate(world, solver.plan(own, seed), self.beliefs, self.episodes, seed)
        margin = half_width(worth.value_se, self.episodes - 1)
        return figures | {
            "policy_value": worth.value,
            "policy_value_se": worth.value_se,
            "policy_value_exact": float(worth.value_is == "exact"),
            "policy_cost": worth.cost,
            "price_of_approximation_low": found.suboptimality(worth.value + margin)[0],
            "price_of_approximation_high": found.suboptimality(worth.value - margin)[1],
        }
