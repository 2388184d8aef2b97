"""The exported file, read back and solved as any POMDP, is the same problem."""

from __future__ import annotations

import os
import re
import subprocess
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings

from tests.explanation.flat_pomdp import Flat, read
from tests.explanation.problems import misleading_problem, tiny_problems
from xplain.errors import InputError, TooLargeError
from xplain.explanation import files
from xplain.explanation.files import pomdp_lines
from xplain.explanation.problem import Problem
from xplain.testing.literal_pomdp import reduced_optimal_value


def text_of(problem: Problem) -> str:
    return "\n".join(pomdp_lines(problem))


def expectimax(flat: Flat, belief: dict[int, float], horizon: int) -> float:
    """Of a general POMDP, knowing nothing of explanations."""
    if horizon == 0:
        return 0.0
    best = -np.inf
    for action in range(flat.actions):
        reward, seen = 0.0, {}
        for state, weight in belief.items():
            reward += weight * flat.reward.get((action, state), 0.0)
            for after, p in flat.transition[action, state].items():
                for o, q in flat.observation[action, after].items():
                    joint = seen.setdefault(o, {})
                    joint[after] = joint.get(after, 0.0) + weight * p * q
        later = 0.0
        for joint in seen.values():
            total = sum(joint.values())
            if set(joint) != {flat.states - 1}:  # the end is worth nothing
                posterior = {state: weight / total for state, weight in joint.items()}
                later += total * expectimax(flat, posterior, horizon - 1)
        best = max(best, reward + flat.discount * later)
    return best


@settings(deadline=None, max_examples=40)
@given(tiny_problems(max_types=2, max_steps=2))
@example(misleading_problem())
def test_the_file_has_the_optimum_of_the_problem(problem: Problem) -> None:
    if problem.discount_per == "step" and problem.discount < 1:
        with pytest.raises(InputError, match="discount_per"):
            text_of(problem)
        return
    flat = read(text_of(problem))
    start = {state: p for state, p in enumerate(flat.start) if p > 0}
    horizon = problem.n_steps + problem.n_messages
    optimum = reduced_optimal_value(problem)
    assert expectimax(flat, start, horizon) == pytest.approx(optimum, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(tiny_problems())
def test_the_file_is_a_pomdp(problem: Problem) -> None:
    """Every row of T and O is there and sums to 1; numbers alone, but for the wildcards of R."""
    if problem.discount_per == "step" and problem.discount < 1:
        return
    text = text_of(problem)
    plain = re.sub(r"(?m)^(R: \d+ : \d+ : )\* : \* ", r"\1", text)
    assert not re.search(r"[A-Za-z*]", re.sub(r"(?m)^(\w+|T|O|R):|reward|e-\d+", "", plain))
    flat = read(text)
    assert sum(flat.start) == pytest.approx(1)
    for action, state in product(range(flat.actions), range(flat.states)):
        assert sum(flat.transition[action, state].values()) == pytest.approx(1)
        assert sum(flat.observation[action, state].values()) == pytest.approx(1)
        assert max(flat.observation[action, state]) < flat.observations


@settings(deadline=None, max_examples=40)
@given(tiny_problems())
def test_rewards_are_one_line_a_state_and_action(problem: Problem) -> None:
    """And each is the expected reward: of *explain*, over every label vector of the prefix."""
    if problem.discount_per == "step" and problem.discount < 1:
        return
    text = text_of(problem)
    flat = read(text)
    n, sets = problem.n_messages, 1 << problem.n_messages
    pairs = re.findall(r"(?m)^R: (\d+) : (\d+) : ", text)
    assert len(pairs) == len(set(pairs)) == problem.n_types * problem.n_steps * sets * (n + 1)
    states = product(range(problem.n_steps), range(sets), range(problem.n_types))
    for here, (k, shown, t) in enumerate(states):
        expected = 0.0
        for labels in product((0, 1), repeat=k + 1):
            chance = 1.0
            for i, label in enumerate(labels):
                p = float(problem.p_explicable[t, i, shown])
                chance *= p if label else 1 - p
            expected -= chance * problem.inexplicability_cost * labels.count(0)
        assert flat.reward[0, here] == pytest.approx(expected, abs=1e-12)
        for j in range(n):
            if j in problem.messages_with_effect and not shown >> j & 1:
                price = problem.trade_off * problem.message_cost[j]
                assert flat.reward[j + 1, here] == pytest.approx(-price, abs=1e-12)
            else:  # worse than all that could still follow, so nobody says a message twice
                labels = problem.n_steps * (problem.n_steps + 1) // 2
                worst = problem.trade_off * problem.message_cost.sum()
                worst += problem.inexplicability_cost * labels
                assert flat.reward[j + 1, here] < -worst


def test_reader_refuses_what_it_does_not_know() -> None:
    text = text_of(Problem(np.full((1, 1, 2), 0.5), np.ones(1)))
    with pytest.raises(InputError, match="line 7"):
        read(text.replace("T: 0 : 0 :", "T: * : 0 :", 1))
    with pytest.raises(InputError, match="line 8"):
        read(text.replace("R: 0 : 0 : * : *", "R: 0 : 0 : 2 : 0", 1))


def test_too_many_lines_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_LINES", 100)
    with pytest.raises(TooLargeError, match="lines"):
        text_of(Problem(np.full((2, 3, 8), 0.5), np.ones(3)))


def test_the_lines_of_answers_count_before_any_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Problem(np.random.default_rng(0).random((2, 4, 4)), np.ones(2))
    written = text_of(problem).splitlines()
    answers = sum(line.startswith("O:") for line in written)
    others = sum(line.startswith(("T:", "R:")) for line in written)
    monkeypatch.setattr(files, "MAX_LINES", others + answers // 2)
    with pytest.raises(TooLargeError, match="lines"):
        next(files.pomdp_lines(problem))


@pytest.mark.skipif("POMDPSOL_PATH" not in os.environ, reason="POMDPSOL_PATH names no pomdpsol")
def test_an_outside_solver_agrees(tmp_path) -> None:
    """SARSOP's bounds enclose the brute-force optimum."""
    rng = np.random.default_rng(2)
    problem = Problem(rng.random((2, 3, 4)), np.array([0.4, 0.7]))
    file = tmp_path / "problem.pomdp"
    file.write_text(text_of(problem) + "\n")
    command = [os.environ["POMDPSOL_PATH"], "--precision", "1e-4", "--timeout", "60"]
    command += ["--output", str(tmp_path / "policy"), str(file)]
    out = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    rows = [line.split() for line in out.splitlines()]
    *_, last = (row for row in rows if len(row) >= 5 and row[0].replace(".", "").isdigit())
    optimum = reduced_optimal_value(problem)
    lower, upper = float(last[3]), float(last[4])
    assert lower - 1e-3 <= optimum <= upper + 1e-3
