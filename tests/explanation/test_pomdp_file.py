"""The exported file, read back and solved as any POMDP, is the same problem."""

import os
import re
import subprocess
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings

from tests.explanation.flat_pomdp import Flat, read
from tests.explanation.problems import misleading_problem, tiny_problems
from xplain.errors import InputError
from xplain.explanation.files import pomdp_lines
from xplain.explanation.problem import Problem
from xplain.testing.literal_pomdp import reduced_optimal_value


def text_of(problem: Problem) -> str:
    return "\n".join(pomdp_lines(problem))


def expectimax(flat: Flat, belief: dict[int, float], horizon: int) -> float:
    """Computes the optimal value of a general POMDP, without knowledge about explanations."""
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
    """Every row of T and O exists and sums to 1; entries are numbers, except for the wildcards of
    R."""
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
