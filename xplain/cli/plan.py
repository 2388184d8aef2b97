"""The command ``plan``, for a saved problem."""

import time
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from xplain.experiment.config import CONF, compose_config
from xplain.explanation.actions import AskQuestion, VisibleState
from xplain.explanation.files import load
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.interaction.statistics import half_width
from xplain.randomness import run_seed
from xplain.report.terminal import BY_CHANCE
from xplain.solvers.base import Policy, messages_of
from xplain.solvers.bounds import Bounds, bounds, known_type_value
from xplain.solvers.evaluate import evaluate
from xplain.solvers.hsvi import CertifiedPolicy, Effort

Row = dict[str, Any]


def compare_solvers(words: list[str]) -> list[Row]:
    """Prints a table of all solvers on one problem. Returns a row for each solver.

    Args:
        words: overrides of conf/plan.yaml, without the solver.
    """
    names = sorted(path.stem for path in (CONF / "solver").glob("*.yaml"))
    configs = [
        compose_config("plan", [*words, f"solver={name}"], with_hydra=True) for name in names
    ]
    known = _compute_bounds(load(configs[0].problem), configs[0])
    rows = [plan_problem(cfg, known) for cfg in configs]
    table = Table("solver", "first decision", "value", "", "optimum", "seconds")
    for row in rows:
        lower, upper = row["optimal_lower"], row["optimal_upper"]
        table.add_row(
            row["solver"],
            _describe_first(row),
            f"{row['value']:.4f}",
            describe_accuracy(row),
            "" if lower is None else f"{lower:.4f} … {upper:.4f}",
            f"{row['seconds']:.3f}",
        )
    Console().print(table)
    return rows


def plan_problem(cfg: DictConfig, known: Bounds | None = None) -> Row:
    """Makes one solver's row, as described in the command's help.

    Args:
        cfg: conf/plan.yaml with its overrides, and the ``hydra`` node.
        known: bounds of the optimum, if already known.
    """
    run_seed(cfg.seed)
    problem = load(cfg.problem)
    solver = instantiate(cfg.solver)
    told = solver.knows in ("type", "labels") and problem.n_types > 1
    began = time.perf_counter()
    policy = solver.plan(problem, cfg.seed)
    asked: Row = {}
    if problem.questions and not told:
        asked = _find_first_question(problem, policy)
    waits = told or asked.get("first_question") is not None
    first = None if waits else indices(messages_of(policy.decide(VisibleState(), problem.start)))
    seconds = time.perf_counter() - began

    row: Row = {"solver": cfg.hydra.runtime.choices.solver, "first_messages": first} | asked
    if told:
        row |= {"value": known_type_value(problem), "value_is": "exact"}
    else:
        worth = evaluate(problem, policy, cfg.value.beliefs, cfg.value.episodes, cfg.seed)
        row |= {"value": worth.value, "value_is": worth.value_is}
        if worth.value_is == "simulated":
            row["value_se"] = worth.value_se
            row["value_half_width"] = half_width(worth.value_se, cfg.value.episodes - 1)
    lower, upper = None, None
    if isinstance(policy, CertifiedPolicy):
        lower, upper = policy.lower, policy.upper
    elif (found := known or _compute_bounds(problem, cfg)) is not None:
        lower, upper = found.lower, found.upper
    return row | {"optimal_lower": lower, "optimal_upper": upper, "seconds": seconds}


def _find_first_question(problem: Problem, policy: Policy) -> Row:
    """Finds the policy's first question, and the values of its possible questions."""

    def words(number: int) -> Row:
        return {"number": number, "question": str(problem.questions.question(number))}

    first = policy.decide(VisibleState(), problem.start)
    values = policy.values(VisibleState(), problem.start).items()
    return {
        "first_question": words(first.question) if isinstance(first, AskQuestion) else None,
        "question_values": [
            words(action.question) | {"value": value}
            for action, value in sorted(values, key=lambda one: -one[1])
            if isinstance(action, AskQuestion)
        ],
    }


def _compute_bounds(problem: Problem, cfg: DictConfig) -> Bounds | None:
    if cfg.bounds.nodes == 0:
        return None
    effort = Effort(cfg.bounds.gap, cfg.bounds.nodes, memory_gib=cfg.bounds.memory_gib)
    return bounds(problem, effort)


def describe_accuracy(row: Row) -> str:
    """Describes the accuracy of a value: ``exact``, or ``simulated ± 0.0412`` with half of the 95 %
    interval."""
    if "value_half_width" not in row:
        return str(row["value_is"])
    upper = row["optimal_upper"]
    beyond = upper is not None and row["value"] > upper
    return f"simulated ± {row['value_half_width']:.4f}" + (BY_CHANCE if beyond else "")


def _describe_first(row: Row) -> str:
    """Describes the first decision in a word or numbers: ``ask 3`` for a question, indices of
    messages, ``none`` without messages, ``by type`` if it depends on the type."""
    if question := row.get("first_question"):
        return f"ask {question['number']}"
    first = row["first_messages"]
    return "by type" if first is None else " ".join(map(str, first)) or "none"
