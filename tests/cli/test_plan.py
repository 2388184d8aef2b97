"""Tests ``python -m xplain plan`` and ``export`` as people and programs use them."""

import json
import re

import numpy as np
import pytest
import scipy.stats

from tests.explanation.test_pomdp_file import read
from tests.refusals import line_of
from xplain.experiment.config import CONF
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.files import load, save
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.testing.literal_pomdp import reduced_optimal_value

SOLVERS = sorted(path.stem for path in (CONF / "solver").glob("*.yaml"))
KEYS = {"solver", "first_messages", "value", "value_is", "optimal_lower", "optimal_upper"}


@pytest.fixture
def file(tmp_path):
    # Solvers differ in what they say first, and the types in how likely they are.
    rng = np.random.default_rng(9)
    path = tmp_path / "problem.npz"
    prior = np.array([0.3, 0.7])
    save(Problem(rng.random((2, 3, 4)), np.array([0.5, 0.8]), 2.0, prior=prior), path)
    return path


def worth_of_first(problem: Problem, messages: list[int]) -> float:
    """Returns the value of these messages with the best continuation, by enumeration."""
    value, factor = 0.0, 1.0
    for cost in sorted(problem.message_cost[messages]):
        value -= factor * problem.trade_off * cost
        factor *= problem.discount
    return value + factor * reduced_optimal_value(problem, 0, sum(1 << j for j in messages))


def test_all_prints_a_comparison_and_one_list_whose_rows_are_plans(run, file) -> None:
    _, out, _ = run("plan", f"problem={file}", "solver=all")
    rows = json.loads(out.splitlines()[-1])
    assert [row["solver"] for row in rows] == SOLVERS
    table, problem = out.split("[{")[0], load(file)
    optimum = reduced_optimal_value(problem)
    alone = [problem.with_types(p[None], ("alone",)) for p in problem.p_explicable]
    known = sum(p * reduced_optimal_value(q) for p, q in zip(problem.prior, alone, strict=True))
    for row in rows:
        # The name, the messages that it gives first, then somewhere behind them the value.
        told = row["first_messages"]
        first = "by type" if told is None else " ".join(map(str, told)) or "none"
        assert re.search(rf"\b{row['solver']} \W+{first}\W.*{row['value']:.4f}", table), row
        assert set(row) >= KEYS | {"seconds"}
        assert row["optimal_lower"] - 1e-9 <= optimum <= row["optimal_upper"] + 1e-9
        assert row["optimal_upper"] - row["optimal_lower"] <= 1e-3 + 1e-9
        if row["solver"] in ("oracle", "clairvoyant"):
            assert row["first_messages"] is None
            assert row["value"] == pytest.approx(known)
        else:
            assert row["value_is"] == "exact"
            first = worth_of_first(problem, row["first_messages"])
            assert row["value"] - 1e-9 <= first <= optimum + 1e-9
            if row["solver"] == "certified":
                assert row["value"] == pytest.approx(optimum, abs=1e-3)
    code, out, err = run("plan", f"problem={file}", "solver=qmdp", "seed=0")
    assert (code, err) == (0, "")
    alone = json.loads(out.splitlines()[-1])
    (compared,) = (row for row in rows if row["solver"] == "qmdp")
    assert alone | {"seconds": 0} == compared | {"seconds": 0}


def test_options_of_the_solver_and_simulated_values(run, file) -> None:
    arguments = [f"problem={file}", "solver=certified", "solver.gap=0.5", "value.beliefs=1"]
    _, out, _ = run("plan", *arguments, "bounds.nodes=0", "value.episodes=9")
    row = json.loads(out.splitlines()[-1])
    assert row["value_is"] == "simulated"
    # Nine episodes.
    assert row["value_half_width"] == pytest.approx(scipy.stats.t.ppf(0.975, 8) * row["value_se"])
    _, out, _ = run("plan", *arguments[:3], "bounds.nodes=0")
    exact = json.loads(out.splitlines()[-1])
    assert exact["value_is"] == "exact"
    assert abs(row["value"] - exact["value"]) < 4 * row["value_se"]
    _, out, _ = run("plan", f"problem={file}", "bounds.nodes=0")
    row = json.loads(out.splitlines()[-1])
    assert (row["optimal_lower"], row["optimal_upper"]) == (None, None)


@pytest.mark.parametrize(
    ("name", "arguments", "said"),
    [
        ("plan", ["problem=nowhere.npz"], "No such file"),
        ("plan", [], "problem"),
        ("plan", ["problem=x.npz", "nonsense=1"], "nonsense"),
        ("plan", ["problem=x.npz", "solver=nonsense"], "solver=nonsense"),
        ("plan", ["x.npz"], "key=value"),
        *(("plan", ["problem=x.npz", f"seed={seed}"], f"seed={seed}") for seed in ("-1", "0.5")),
        ("plan", ["problem=x.npz", "seed=x"], "seed='x'"),
        ("export", ["problem=nowhere.npz", "output=x.pomdp"], "No such file"),
        ("export", ["problem=x.npz", "nonsense=1", "output=x.pomdp"], "nonsense"),
        ("export", ["x.npz"], "key=value"),
    ],
)
def test_bad_arguments_are_one_line(run, name, arguments, said) -> None:
    assert said in line_of(run(name, *arguments))


def test_a_solver_too_small_for_the_problem_says_who_can(run, file) -> None:
    words = (f"problem={file}", "solver=certified", "solver.memory_gib=1e-7")
    assert "solver=qhr" in line_of(run("plan", *words))


def test_export_writes_the_file_whole(run, file, tmp_path) -> None:
    code, _, _ = run("export", f"problem={file}", f"output={tmp_path / 'p.pomdp'}")
    assert code == 0
    assert read((tmp_path / "p.pomdp").read_text()).states == 2 * 3 * 4 + 1
    line = line_of(run("export", f"problem={file}", "output=q.pomdp", "format=word"))
    assert line == "xplain: format='word': pomdp\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.pomdp", "problem.npz"]


@pytest.fixture
def asking(tmp_path):
    """Makes one question that distinguishes the two types, and is worth its cost."""
    p = np.array([[[0.0, 1.0]] * 3, [[1.0, 1.0]] * 3])
    clip = LabelTable.dense(np.array([[[0.0, 1.0]], [[1.0, 1.0]]]))
    questions = Questions(clip, Limits(cost=0.125), texts=("refuels",))
    path = tmp_path / "asking.npz"
    save(Problem(p, np.array([2.0]), discount=1.0, questions=questions), path)
    return path


def test_a_saved_question_is_planned_with_by_those_who_ask(run, asking) -> None:
    """Half of the users need the message, which costs 2. Without the question, half see an
    inexplicable step or all get the message; with a question first, the plan costs 0.125 + 1."""
    code, out, _ = run("plan", f"problem={asking}", "solver=all")
    rows = {row["solver"]: row for row in json.loads(out.splitlines()[-1])}
    assert (code, "ask 0" in out) == (0, True)
    assert rows["conformant"]["first_question"] is None
    assert "first_question" not in rows["oracle"]
    assert rows["conformant"]["value"] == pytest.approx(-2)
    for row in (rows["qmdp"], rows["certified"]):
        assert row["first_messages"] is None
        assert row["first_question"] == {"number": 0, "question": "refuels"}
        (told,) = row["question_values"]
        assert told["number"] == 0
        assert told["value"] == pytest.approx(-1.125, abs=0.01)
        assert row["value"] == pytest.approx(-1.125)
        assert row["optimal_upper"] == pytest.approx(-1.125, abs=0.01)


def test_questions_are_not_exported(run, asking, tmp_path) -> None:
    output = tmp_path / "asking.pomdp"
    assert "question" in line_of(run("export", f"problem={asking}", f"output={output}"))
    assert not output.exists()
