"""Tests ``python -m xplain plan`` and ``export`` as people and programs use them."""

import json
import re

import numpy as np
import pytest

from tests.explanation.test_pomdp_file import read
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
        # The name, then somewhere behind it the value.
        assert re.search(rf"\b{row['solver']} .*{row['value']:.4f}", table), row
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
    _, out, _ = run("plan", *arguments, "bounds.nodes=0")
    row = json.loads(out.splitlines()[-1])
    assert row["value_is"] == "simulated"
    assert row["value_se"] > 0
    _, out, _ = run("plan", *arguments[:3], "bounds.nodes=0")
    exact = json.loads(out.splitlines()[-1])
    assert exact["value_is"] == "exact"
    assert abs(row["value"] - exact["value"]) < 4 * row["value_se"]
    _, out, _ = run("plan", f"problem={file}", "bounds.nodes=0")
    row = json.loads(out.splitlines()[-1])
    assert (row["optimal_lower"], row["optimal_upper"]) == (None, None)


def broken(tmp_path, **changes: object) -> str:
    good = {"p_explicable": np.full((2, 3, 4), 0.5), "message_cost": np.ones(2)}
    arrays = {key: value for key, value in (good | changes).items() if value is not None}
    np.savez(tmp_path / "broken.npz", **arrays)
    return f"problem={tmp_path / 'broken.npz'}"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"p_explicable": np.full((2, 3, 4), 1.5)}, "p_explicable=1.5"),
        ({"p_explicable": np.full((2, 3, 4), np.nan)}, "p_explicable=nan"),
        ({"p_explicable": np.full((2, 3, 5), 0.5)}, "power of two"),
        ({"p_explicable": np.full((3, 4), 0.5)}, "p_explicable=(3, 4)"),
        ({"p_explicable": np.full((1, 1, 1 << 21), 0.5)}, "at most 2**20"),
        ({"p_explicable": np.array([[["a", "b"]]])}, "numbers"),
        ({"p_explicable": None}, "lacks p_explicable"),
        ({"message_cost": np.ones(3)}, "message_cost"),
        ({"message_cost": np.array([-1.0, 1.0])}, "message_cost"),
        ({"prior": np.array([0.5, 0.6])}, "prior"),
        ({"discount": 1.5}, "discount=1.5"),
        ({"discount": np.nan}, "discount"),
        ({"trade_off": -1.0}, "lambda (trade_off)=-1.0"),
        ({"discount_per": "minute"}, "discount_per='minute'"),
        ({"surprise": 1.0}, "unknown array"),
    ],
)
def test_bad_files_are_one_line(run, tmp_path, changes, said) -> None:
    code, out, err = run("plan", broken(tmp_path, **changes))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["problem=nowhere.npz"], "No such file"),
        ([], "problem"),
        (["problem=x.npz", "nonsense=1"], "nonsense"),
        (["problem=x.npz", "solver=nonsense"], "solver=nonsense"),
        (["x.npz"], "key=value"),
    ],
)
def test_bad_arguments_are_one_line(run, arguments, said) -> None:
    for name in ("plan", "export"):
        if name == "plan" or said in ("No such file", "nonsense", "key=value"):
            more = [] if name == "plan" else ["output=x.pomdp"]
            code, out, err = run(name, *arguments, *more)
            assert (code, out, err.count("\n")) == (2, "", 1)
            assert said in err


def test_bad_seed(run, file) -> None:
    for seed in ("x", "-1", "0.5"):
        code, out, err = run("plan", f"problem={file}", f"seed={seed}")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "seed" in err
        assert seed in err


def test_a_solver_too_small_for_the_problem_says_who_can(run, file) -> None:
    code, _, err = run("plan", f"problem={file}", "solver=certified", "solver.memory_gib=1e-7")
    assert code == 2
    assert "solver=qhr" in err


def test_export_writes_the_file_whole(run, file, tmp_path) -> None:
    code, _, _ = run("export", f"problem={file}", f"output={tmp_path / 'p.pomdp'}")
    assert code == 0
    assert read((tmp_path / "p.pomdp").read_text()).states == 2 * 3 * 4 + 1
    code, _, err = run("export", f"problem={file}", f"output={tmp_path / 'q.pomdp'}", "format=word")
    assert (code, err) == (2, "xplain: format='word': pomdp\n")
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


@pytest.mark.parametrize("solver", ["qmdp", "certified"])
def test_a_saved_question_is_planned_with(run, asking, solver) -> None:
    """Half of the users need the message, which costs 2; with a question first, the plan costs
    0.125 + 1."""
    code, out, _ = run("plan", f"problem={asking}", f"solver={solver}")
    row = json.loads(out.splitlines()[-1])
    assert (code, row["first_messages"]) == (0, None)
    assert row["first_question"] == {"number": 0, "question": "refuels"}
    (told,) = row["question_values"]
    assert told["number"] == 0
    assert told["value"] == pytest.approx(-1.125, abs=0.01)
    assert row["value"] == pytest.approx(-1.125)
    assert row["optimal_upper"] == pytest.approx(-1.125, abs=0.01)


def test_a_solver_that_never_asks_is_compared_as_one_that_does_not(run, asking) -> None:
    """Without the question, half of the users see an inexplicable step or all get the message."""
    code, out, _ = run("plan", f"problem={asking}", "solver=all")
    rows = {row["solver"]: row for row in json.loads(out.splitlines()[-1])}
    assert code == 0
    assert rows["conformant"]["first_question"] is None
    assert rows["conformant"]["value"] == pytest.approx(-2)
    assert rows["qmdp"]["first_question"] is not None
    assert "ask 0" in out


def test_questions_are_not_exported(run, asking, tmp_path) -> None:
    output = tmp_path / "asking.pomdp"
    code, _, err = run("export", f"problem={asking}", f"output={output}")
    assert (code, err.count("\n")) == (2, 1)
    assert "question" in err
    assert not output.exists()
