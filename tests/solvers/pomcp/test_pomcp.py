"""POMCP: against a plain reference on the same random words, brute force, and its own limits."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.decisions import messages_given, question_asked, worths
from tests.explanation.problems import misleading_problem
from tests.solvers.plain_values import plain_optimal_value
from tests.solvers.pomcp.plain_pomcp import PlainPOMCP
from xplain.errors import InputError, TooLargeError
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.literal_pomdp import reduced_optimal_value
from xplain.explanation.problem import Problem
from xplain.numba_kernels import kernel
from xplain.solvers.evaluate import evaluate
from xplain.solvers.model import best_set
from xplain.solvers.pomcp import search_model
from xplain.solvers.pomcp import solver as pomcp
from xplain.solvers.pomcp.kernel import simulate
from xplain.solvers.pomcp.labels import draw_labels, update_belief
from xplain.solvers.pomcp.search_model import model_bytes, model_of
from xplain.solvers.pomcp.solver import POMCP, Search
from xplain.solvers.pomcp.tree import FIRST_TABLE, SearchRoot, Tree, make_roots, tree_bytes
from xplain.testing.problems import random_problem


def soft_problem(seed: int, types: int = 3, steps: int = 4, n: int = 3, **kwargs: Any) -> Problem:
    """Every message has an effect, and no two values are alike."""
    rng = np.random.default_rng(seed)
    settings = {"trade_off": 0.7, "discount": 0.9, "prior": rng.dirichlet(np.ones(types))} | kwargs
    return Problem(rng.random((types, steps, 1 << n)), 0.2 + rng.random(n), **settings)


def search_of(solver: POMCP, problem: Problem, seed: int = 0) -> Search:
    """The search behind the policy, where no message is left out."""
    restricted: Any = solver.plan(problem, seed)
    assert len(restricted.kept) == problem.n_messages
    search: Search = restricted.policy
    return search


def first_values(solver: POMCP, problem: Problem, seed: int = 0) -> dict[int, float]:
    return dict(worths(solver.plan(problem, seed), 0, 0, problem.prior))


@pytest.mark.parametrize("backup", ["mean", "max"])
@pytest.mark.parametrize(
    ("depth", "depth_unit"), [(1, "steps"), (2, "actions"), (3, "actions"), (None, "actions")]
)
def test_is_the_plain_search(backup: Any, depth: int | None, depth_unit: Any) -> None:
    """Same words, same visits and values, from the start and in the middle, for random tables and
    one with exchangeable and uninformative labels, for every discounting, where a 0 is the dearest
    and where a message is. (Where messages do not discount, their orders tie, and rounding decides:
    one message then.)"""
    solver = POMCP(
        simulations=700, depth=depth, depth_unit=depth_unit, exploration=1.5, backup=backup
    )
    repeated = soft_problem(3)
    p = repeated.p_explicable.copy()
    p[:, 2], p[:, 1] = p[:, 0], p[:1, 1]
    problems = [
        soft_problem(1),
        soft_problem(2, n=1, discount_per="step", prior=np.array([0.5, 0.5, 0.0])),
        soft_problem(4, n=1, discount=1.0),
        soft_problem(5, trade_off=4.0),
        replace(repeated, table=p),
    ]
    # Each problem from the start in some settings, from the middle in the others.
    turn = len(backup) + (depth or 0)
    for number, problem in enumerate(problems):
        middle = (number + turn) % 2 == 1
        step, given = (2, 4 if problem.n_messages > 1 else 0) if middle else (0, 0)
        search = search_of(solver, problem)
        tree = Tree.rooted(
            700, problem.n_messages, problem.n_steps, SearchRoot(step, given, problem.prior), 99
        )
        simulate(700, search.model, search.options, tree, *make_roots(702))
        expected = PlainPOMCP(solver, problem, 99, step, given, problem.prior).run()
        for action, edge in enumerate(tree.root_edges()):
            visits, value = expected.get(action, [0, -np.inf])
            assert edge["visits"] == visits
            assert edge["value"] == pytest.approx(value, rel=1e-9)


def test_approaches_the_optimum() -> None:
    """Full depth and many simulations: the value of the root, and the exact worth of the policy,
    come close to brute force on problems of every kind."""
    rng = np.random.default_rng(5)
    solver = POMCP(simulations=20_000, depth=None, exploration=4.0)
    for _ in range(25):
        problem = random_problem(rng)
        optimum = reduced_optimal_value(problem)
        policy = solver.plan(problem)
        allowed = 0.02 * (0.1 + abs(optimum))
        best = max(worths(policy, 0, 0, problem.prior).values())
        assert best == pytest.approx(optimum, abs=allowed)
        assert evaluate(problem, policy).value == pytest.approx(optimum, abs=allowed)


def test_who_errs_is_searched_for_by_answers() -> None:
    problem = misleading_problem()
    found = max(first_values(POMCP(simulations=30_000, depth=None), problem).values())
    assert found == pytest.approx(reduced_optimal_value(problem), abs=0.02)


def test_the_mean_approaches_the_optimum_too() -> None:
    """As the paper's POMCP does; more slowly, as the mean remembers what was tried."""
    rng = np.random.default_rng(6)
    for _ in range(8):
        problem = random_problem(rng)
        optimum = reduced_optimal_value(problem)
        solver = POMCP(simulations=200_000, depth=None, backup="mean", exploration=1.0)
        best = max(first_values(solver, problem).values())
        assert best == pytest.approx(optimum, abs=0.05 * (0.1 + abs(optimum)))


def test_steps_do_not_count_messages() -> None:
    """With depth 1 in steps, all messages can come before the leaf; in actions only one."""
    problem = soft_problem(9, steps=2, n=2)
    opened = {}
    for unit in ("actions", "steps"):
        search = search_of(POMCP(depth=1, depth_unit=unit), problem)
        tree = Tree.rooted(2000, 2, 2, SearchRoot(0, 0, problem.prior), 1)
        simulate(2000, search.model, search.options, tree, *make_roots(2002))
        nodes = tree.nodes[: tree.used[0]]
        opened[unit] = {int(node["given"]) for node in nodes if node["edges"]}
    assert opened == {"actions": {0}, "steps": {0, 1, 2, 3}}


def test_without_messages_the_value_is_the_cost() -> None:
    """Nothing to decide: the exact expectation, whatever is drawn."""
    problem = soft_problem(10, n=0, steps=3)
    zeros = np.cumsum(problem.prior @ (1 - problem.p_explicable[:, :, 0]))
    cost = sum(0.9**k * z for k, z in enumerate(zeros))
    value = first_values(POMCP(simulations=4000, depth=None, exploration=1.0), problem)
    assert value[0] == pytest.approx(-cost, rel=0.03)
    known = replace(problem, prior=np.array([0.0, 1.0, 0.0]))
    value = first_values(POMCP(simulations=400, depth=None), known)
    zeros = np.cumsum(1 - problem.p_explicable[1, :, 0])
    assert value[0] == pytest.approx(-sum(0.9**k * z for k, z in enumerate(zeros)))


def test_labels_are_drawn_with_their_probabilities() -> None:
    """Within 5 standard errors each, certain ones always, neighbours independent; and the
    posterior is Bayes' for them, whether or not the labels were met before."""
    p = np.array([0.0, 1.0, 0.5, 0.02, 0.98, 0.3, 1e-4, 0.9999])
    draws, count = 40_000, len(p)
    other = np.random.default_rng(3).uniform(0.1, 0.9, count)
    problem = Problem(np.stack([p, other])[:, :, None], np.empty(0))
    model = model_of(problem)
    first, tree = (Tree.rooted(draws, 0, count, SearchRoot(0, 0, problem.prior), 1) for _ in "12")
    _draw_many(1, model, first, problem.prior)  # codes the observations
    model.weight[0] = 1 << np.arange(count, dtype=np.uint64)
    for t in range(2):
        usual = model.p[0, :, t] < 0.5
        model.likeliest["code"][0, :, t] = np.cumsum(usual * model.weight[0])
    labels, beliefs = _draw_many(draws, model, tree, problem.prior)
    error = np.sqrt(p * (1 - p) / draws)
    assert np.all(np.abs(labels.mean(axis=0) - p) <= 5 * error)
    soft = labels[:, [2, 3, 4, 5]]
    off_diagonal = np.corrcoef(soft.T)[~np.eye(4, dtype=bool)]
    assert np.abs(off_diagonal).max() < 5 / np.sqrt(draws)
    likelihood = np.where(labels[:, None], [p, other], [1 - p, 1 - other]).prod(axis=2)
    expected = likelihood / likelihood.sum(axis=1, keepdims=True)
    assert beliefs == pytest.approx(expected, rel=1e-9)


@kernel
def _draw_many(draws, model, tree, prior):  # type: ignore[no-untyped-def]
    """Labels [draws, m] of a user of the first type after all is shown, and beliefs after them."""
    steps = model.p.shape[1]
    labels, beliefs = np.empty((draws, steps), np.bool_), np.empty((draws, 2))
    for d in range(draws):
        code = draw_labels(model, tree, steps - 1, 0, 0)
        for i in range(steps):
            labels[d, i] = not code >> np.uint64(i) & np.uint64(1)
        beliefs[d] = prior
        update_belief(model, tree, steps - 1, 0, 0, code, beliefs[d])
    return labels, beliefs


def test_exchangeable_labels_share_a_history() -> None:
    """Six equal transitions that tell the types apart, one that does not: 7 counts, not 2^7."""
    p = np.full((2, 8, 1), 0.5)
    p[0, :6], p[1, :6] = 0.6, 0.4
    problem = Problem(p, np.empty(0))
    search = search_of(POMCP(), problem)
    tree = Tree.rooted(5000, 0, 8, SearchRoot(6, 0, problem.prior), 1)
    options = search.options._replace(depth=1)
    simulate(5000, search.model, options, tree, *make_roots(5002))
    assert tree.used[0] == 1 + 7
    assert len(np.unique(tree.beliefs[1:8, 0])) == 7


def test_a_decision_goes_on_in_the_middle_as_from_the_start() -> None:
    """After the first message, the same search follows: a policy of (step, given, belief)."""
    for seed in range(6):
        problem = soft_problem(seed, trade_off=0.05)
        policy = POMCP(simulations=500).plan(problem, 3)
        whole = messages_given(policy, 1, 0, problem.prior)
        values = worths(policy, 1, 0, problem.prior)
        first = max(values, key=values.__getitem__)
        assert whole & first == first
        assert first == 0 or whole == first | messages_given(policy, 1, first, problem.prior)


@pytest.mark.parametrize("seed", range(4))
def test_a_certain_type_is_worth_its_optimum_and_a_search_would_find_it(seed: int) -> None:
    """Of right and of noisy labels, at every (k, H)."""
    soft = soft_problem(seed)
    for problem in (soft, replace(soft, table=np.round(soft.p_explicable))):
        policy, search = POMCP().plan(problem), search_of(POMCP(simulations=3000), problem)
        for t, k, given in product(range(3), range(4), range(8)):
            belief = np.eye(3)[t]
            known = worths(policy, k, given, belief)
            best = plain_optimal_value(problem, t, k, given)
            assert max(known.values()) == pytest.approx(best)
            value, visits = search.search(SearchRoot(k, given, belief))
            assert set(known) == {0 if a == 3 else 1 << a for a in np.flatnonzero(visits)}
            searched = value[-1 if best_set(known) == 0 else best_set(known).bit_length() - 1]
            assert searched >= value[visits > 0].max() - 1e-9
            # Of noisy labels, what few simulations came to is not settled yet.
            assert searched == pytest.approx(best, abs=0.05)


def test_a_certain_type_is_searched_for_where_the_limit_is_another() -> None:
    problem = soft_problem(1)
    search = search_of(POMCP(backup="mean", simulations=50), problem)
    value, _ = search.search(SearchRoot(1, 0, np.eye(3)[0]))
    assert worths(search, 1, 0, np.eye(3)[0])[0] == value[-1]
    nearly, search = np.array([0.995, 0.005, 0.0]), search_of(POMCP(simulations=50), problem)
    value, _ = search.search(SearchRoot(1, 0, nearly))
    assert worths(search, 1, 0, nearly)[0] == value[-1]


def test_the_unit_of_cost_does_not_matter() -> None:
    """All costs times 2^7: the same visits, values times 2^7, exactly."""
    problem = soft_problem(12)
    dear = replace(problem, message_cost=problem.message_cost * 128, inexplicability_cost=128.0)
    root = SearchRoot(0, 0, problem.prior)
    value, visits = search_of(POMCP(), problem).search(root)
    dear_value, dear_visits = search_of(POMCP(), dear).search(root)
    assert np.array_equal(visits, dear_visits)
    assert np.array_equal(value * 128, dear_value)


def test_many_simulations_are_one_search_however_often_ctrl_c_is_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """700 in parts of 300 are 700 at once."""
    problem = soft_problem(16)
    search = search_of(POMCP(simulations=700), problem)
    root = SearchRoot(0, 0, problem.prior)
    whole = search.search(root)
    monkeypatch.setattr(pomcp, "CHUNK", 300)
    value, visits = search.search(root)
    assert visits.sum() == 700
    assert (value.tolist(), visits.tolist()) == (whole[0].tolist(), whole[1].tolist())


def test_more_message_sets_than_are_kept_coded_are_searched_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Sixteen places for 64 sets: what is coded for another set is coded anew."""
    problem = soft_problem(17, n=6, trade_off=0.1)
    found = []
    for cache in (search_model.CACHE, 1):
        monkeypatch.setattr(search_model, "CACHE", cache)
        search = search_of(POMCP(simulations=3000, depth=None), problem)
        root = SearchRoot(0, 0, problem.prior)
        found.append((len(search.model.coded), *search.search(root)))
    (many, value, visits), (few, *again) = found
    assert (many, few) == (64, 16)
    assert [each.tolist() for each in again] == [value.tolist(), visits.tolist()]


@pytest.mark.parametrize("messages", [1, 30, 31, 61])
def test_a_nodes_masks_hold_every_action(messages: int) -> None:
    """*explain* has a bit of its own beside the messages'."""
    tree = Tree.rooted(1, messages, 1, SearchRoot(0, 0, np.ones(1)), 0)
    tree.nodes["untried"][0] = (1 << (messages + 1)) - 1
    assert int(tree.nodes["untried"][0]).bit_count() == messages + 1
    assert np.iinfo(tree.nodes.dtype["given"]).max >= (1 << messages) - 1


PRINT_SEARCH = """
import json, numpy as np
from tests.decisions import messages_given, worths
from xplain.explanation.problem import Problem
from xplain.solvers.pomcp.solver import POMCP
rng = np.random.default_rng(1)
problem = Problem(rng.random((3, 4, 8)), np.ones(3), trade_off=0.3)
policy = POMCP(simulations=3000).plan(problem, 5)
values = worths(policy, 1, 2, problem.prior)
print(json.dumps([[*values.items()], messages_given(policy, 0, 0, problem.prior)]))
"""


def test_the_same_in_another_process() -> None:
    """Seed, step, given and belief alone decide."""
    command = [sys.executable, "-c", PRINT_SEARCH]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rng = np.random.default_rng(1)
    problem = Problem(rng.random((3, 4, 8)), np.ones(3), trade_off=0.3)
    policies = [POMCP(simulations=3000).plan(problem, s) for s in (5, 6)]
    values = [worths(policy, 1, 2, problem.prior) for policy in policies]
    here = [
        [[k, v] for k, v in values[0].items()],
        messages_given(policies[0], 0, 0, problem.prior),
    ]
    assert json.loads(output) == here
    assert values[0] != values[1]


def test_ctrl_c_ends_the_search_and_breaks_nothing() -> None:
    """KeyboardInterrupt reaches the caller; the same policy answers afterwards as before."""
    problem = soft_problem(14, types=5, steps=12, n=6)
    policy = POMCP(simulations=8_000_000, depth=None).plan(problem)
    short = POMCP(simulations=500).plan(problem)
    before = worths(short, 0, 0, problem.prior)
    timer = threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        worths(policy, 0, 0, problem.prior)
    timer.join()
    assert worths(short, 0, 0, problem.prior) == before


def asking_problem(accept: float) -> Problem:
    """Three messages, two noisy questions; messages may be missed."""
    rng = np.random.default_rng(4)
    asked = Questions(LabelTable.dense(rng.uniform(0.1, 0.9, (3, 2, 8))), Limits(0.01, 2))
    problem = soft_problem(1, steps=3, questions=asked)
    habits = Habits(np.zeros(1), np.array([accept]), np.zeros(1), np.ones(1))
    return problem if accept == 1.0 else problem.with_habits(habits)


@pytest.mark.parametrize("accept", [1.0, 0.7])
def test_each_action_is_tried_where_there_are_fewer_simulations(accept: float) -> None:
    """A question, a message and *explain* are never weighed against nothing."""
    problem = asking_problem(accept)
    for seed in range(20):
        policy: Any = POMCP(simulations=1).plan(problem, seed)
        question_asked(policy, 0, 0, problem.start)
        assert worths(policy, 0, 0, problem.start).keys() == {0, 1, 2, 4, ~0, ~1}


def test_threads_that_share_a_plan_decide_as_one_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a server's do. With few places, observations are coded anew all the time."""
    monkeypatch.setattr(search_model, "CACHE", 1)
    solver = POMCP(simulations=4000, depth=None)
    for seed in range(3):
        problem = soft_problem(17 + seed, types=4, steps=8, n=8, trade_off=0.1)
        beliefs = np.random.default_rng(3).dirichlet(np.ones(4), 12)
        alone = [worths(solver.plan(problem), 0, 0, belief) for belief in beliefs]
        decide = partial(worths, solver.plan(problem), 0, 0)
        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(decide, beliefs)) == alone


def test_too_large_is_refused_with_the_size_before_memory_is_taken() -> None:
    """For tables and for trees."""
    wide = Problem(np.random.default_rng(0).random((1, 1, 1 << 16)), np.zeros(16))
    with pytest.raises(TooLargeError, match=r"pomcp needs 0.\d+ GiB .* qhr"):
        POMCP(memory_gib=0.001).plan(wide)
    with pytest.raises(TooLargeError, match=r"pomcp needs \d+.\d+ GiB"):
        POMCP(simulations=10**9).plan(soft_problem(1))


@pytest.mark.parametrize(
    ("key", "value"),
    [("simulations", 0), ("simulations", 2.5), ("simulations", True), ("depth", 0),
     ("depth_unit", "metres"), ("exploration", -1.0), ("exploration", float("nan")),
     ("exploration", "high"), ("backup", "sum"), ("memory_gib", -1)],
)  # fmt: skip
def test_names_the_setting_that_is_wrong(key: str, value: object) -> None:
    """Key, value and what is allowed."""
    with pytest.raises(InputError, match=f"solver.{key}="):
        POMCP(**{key: value})  # type: ignore[arg-type]


def test_defaults_are_the_configurations() -> None:
    """Who embeds POMCP() gets what `solver=pomcp` runs."""
    path = Path(__file__).parents[3] / "conf" / "solver" / "pomcp.yaml"
    chosen = yaml.safe_load(path.read_text())
    assert chosen.pop("_target_") == f"{POMCP.__module__}.{POMCP.__qualname__}"
    assert chosen == {key: value for key, value in asdict(POMCP()).items() if key != "knows"}


def test_trees_take_no_more_than_told() -> None:
    """What the refusal counts is what is allocated."""
    problem = soft_problem(15)
    tree = Tree.rooted(1000, 3, 4, SearchRoot(0, 0, problem.prior), 0)
    model = model_of(problem)
    own = [a for a in tree if isinstance(a, np.ndarray)]
    assert sum(a.nbytes for a in own) == pytest.approx(tree_bytes(problem, 1000), rel=0.01)
    start = SearchRoot(0, 0, problem.prior)
    small = Tree.rooted(1, problem.n_messages, problem.n_steps, start, 0)
    counted = (small.nodes, small.edges, small.beliefs, small.table, small.seen, small.likelihoods)
    assert sum(a.nbytes for a in counted) <= tree_bytes(problem, 1)  # the most that it takes
    held = sum(a.nbytes for a in model if isinstance(a, np.ndarray))
    assert 0.5 * model_bytes(problem) < held <= model_bytes(problem)


def test_a_table_grows_with_the_tree_and_holds_every_child() -> None:
    problem = soft_problem(3, steps=6, n=5)
    search = search_of(POMCP(simulations=1, depth=None, depth_unit="steps"), problem)
    tree = Tree.rooted(20_000, 5, 6, SearchRoot(0, 0, problem.prior), 0)
    simulate(20_000, search.model, search.options, tree, *make_roots(1 << 15))
    nodes, _, mask = tree.used.tolist()
    assert nodes > FIRST_TABLE  # else nothing would have grown
    assert 2 * nodes <= mask + 3
    held = tree.table["node"][: mask + 1]
    assert np.array_equal(np.sort(held[held > 0]), np.arange(1, nodes))
    assert not tree.table["node"][mask + 1 :].any()
