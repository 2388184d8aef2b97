"""Compares Gymnasium domains with the environments, which are played."""

import sys
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.domains.configs import believed, domain_of, given
from tests.refusals import refused
from xplain.errors import InputError, XplainError

gymnasium = pytest.importorskip("gymnasium", reason="pip install 'xplain-hri[gym]'")
from xplain.domains.gym import Gymnasium, read_model  # noqa: E402

NAMES = ["taxi", "cliff_walking", "frozen_lake"]


@pytest.mark.parametrize("name", NAMES)
def test_the_robots_model_is_what_the_environment_does(name: str) -> None:
    """Played at random, every outcome has its probability and reward, and ends when it should."""
    model, arguments = believed(domain_of(f"domain={name}")), given(name)
    environment = gymnasium.make(arguments["id"], **(arguments["arguments"] or {})).unwrapped
    rng = np.random.default_rng(0)
    counts: dict[tuple[int, int], list[int]] = {}
    state, _ = environment.reset(seed=0)
    for _ in range(4000):
        action = int(rng.integers(model.n_actions))
        after, reward, ended, *_ = environment.step(action)
        slots = (model.successor[state, action] == after) & (model.probability[state, action] > 0)
        assert slots.any()
        assert set(model.reward[state, action][slots]) == {reward}
        assert model.terminal[after] == ended
        counts.setdefault((int(state), action), []).append(int(after))
        state = environment.reset()[0] if ended else after
    for (s, a), reached in counts.items():
        if len(reached) < 100:
            continue
        for after in set(model.successor[s, a]):
            p = model.probability[s, a][model.successor[s, a] == after].sum()
            seen = np.mean(np.array(reached) == after)
            assert abs(seen - p) <= 5 * np.sqrt(p * (1 - p) / len(reached)) + 1e-9


def test_a_changed_transition_leads_where_the_change_says() -> None:
    taxi = domain_of("domain=taxi")
    before, after = believed(taxi), believed(taxi, "bridge")
    changed = (before.successor != after.successor).any(axis=2)
    for s, a in np.argwhere(changed):
        assert taxi.position(s) == taxi.position(before.successor[s, a, 0])  # a wall
        row, column = taxi.position(after.successor[s, a, 0])
        assert (row, {taxi.position(s)[1], column}) == (0, {1, 2})
        assert np.array_equal(
            taxi.state_features[s][2:], taxi.state_features[after.successor[s, a, 0]][2:]
        )
    assert changed.sum() == 2 * 5 * 4


def shown(table: dict[int, dict[int, list[Any]]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every environment have this model and start in state 0."""
    initial = [1.0] + [0.0] * (len(table) - 1)
    made = SimpleNamespace(
        unwrapped=SimpleNamespace(P=table, initial_state_distrib=initial), close=lambda: None
    )
    monkeypatch.setattr(gymnasium, "make", lambda *a, **k: made)


def test_arguments_of_all_parameters_count_and_the_others_stay() -> None:
    """Each of two parameters has arguments, besides those of the environment."""
    arguments = given("frozen_lake")
    ice, lake = [{"arguments": {"is_slippery": False}}], [{"arguments": {"desc": ["SFFH"] * 4}}]
    arguments["arguments"] = {
        "map_name": "4x4",
        "is_slippery": True,
        "desc": ["SFFF"] * 3 + ["FFFG"],
    }
    arguments["parameters"] = {
        "ice": {"inaccurate": ice, "message": "It is slippery."},
        "lake": {"inaccurate": lake, "message": "There are no holes."},
    }
    made = Gymnasium(**arguments)
    for held_ice, held_lake in product([[], ice], [[], lake]):
        expected = arguments["arguments"].copy()
        for change in (*held_ice, *held_lake):
            expected |= change["arguments"]
        theirs = gymnasium.make("FrozenLake-v1", **expected).unwrapped.P
        model = made.model({"ice": held_ice, "lake": held_lake})
        for s, a in product(range(16), range(4)):
            likely = model.probability[s, a] > 0
            found = zip(model.successor[s, a][likely], model.probability[s, a][likely], strict=True)
            assert list(found) == [(after, p) for p, after, *_ in theirs[s][a]]
        ends = {after for row in theirs.values() for x in row.values() for _, after, _, e in x if e}
        assert set(np.flatnonzero(model.terminal)) == ends


EFFECTS = [{"add": 2.0}, {"add": -1.0, "next": {"row": [1, 2]}}, {"like": "up"}, {"to": {"row": 0}}]
WHERE = [{}, {"when": {"row": [0, 2], "column": 1}}, {"actions": ["left", "down"]}]
CELLS = [{"row": row, "column": column} for row in range(4) for column in range(4)]


def meets(state: int, condition: dict[str, Any]) -> bool:
    """True if a state meets a condition."""
    wanted = {
        key: value if isinstance(value, list) else [value] for key, value in condition.items()
    }
    return all(CELLS[state][key] in values for key, values in wanted.items())


def test_changes_are_applied_one_after_the_other(rng_of_the_day: np.random.Generator) -> None:
    """Each outcome of frozen_lake is compared with a loop over random changes."""
    rng = rng_of_the_day
    for _ in range(10):
        changes = [EFFECTS[rng.integers(4)] | WHERE[rng.integers(3)] for _ in range(3)]
        wrong = {"x": {"inaccurate": changes, "message": "No."}}
        made = Gymnasium(**given("frozen_lake") | {"parameters": wrong})
        before, after = believed(made), believed(made, "x")
        for s, a, k in np.ndindex(before.successor.shape):
            like, led, reward = a, before.successor[s, a, k], before.reward[s, a, k]
            for one in changes:
                if not meets(s, one.get("when", {})):
                    continue
                if made.actions[a] not in one.get("actions", made.actions):
                    continue
                if "like" in one:
                    like = made.actions.index(one["like"])
                    led, reward = before.successor[s, like, k], before.reward[s, like, k]
                elif "to" in one:
                    led = CELLS.index(CELLS[s] | one["to"])
                elif meets(led, one.get("next", {})):
                    reward += one["add"]
            assert (after.successor[s, a, k], after.reward[s, a, k]) == (led, reward)
            assert after.probability[s, a, k] == before.probability[s, like, k]


def test_an_outcome_that_never_comes_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    never = [(1.0, 1, 0.0, False), (0.0, 1, 0.0, True)]
    shown({0: {0: never}, 1: {0: [(1.0, 0, 0.0, False)]}}, monkeypatch)
    change = [{"add": 1.0}]
    parameters = {"x": {"inaccurate": change, "message": "No."}}
    made = Gymnasium("Two", {"place": 2}, ["go"], 0.9, parameters)
    assert not made.model({"x": []}).terminal.any()


END = {0: [(1.0, 2, 0.0, True)], 1: [(1.0, 2, 0.0, True)]}
ROWS = {s: {a: [(1.0, max(s + 2 * a - 1, 0), -1.0, s + a == 2)] for a in (0, 1)} for s in (0, 1)}


@pytest.mark.parametrize(
    "table",
    [
        [*ROWS.values(), END],
        {s: [*row.values()] for s, row in {**ROWS, 2: END}.items()},
        np.array([[[row[a][0]] for a in (0, 1)] for row in (*ROWS.values(), END)]),
        {np.int64(s): {a: np.array(x) for a, x in row.items()} for s, row in ROWS.items()},
        {s: {a: [*x, (0.0, -1, np.nan, True)] for a, x in row.items()} for s, row in ROWS.items()},
        {**ROWS, 2: {}},
        {**ROWS, 2: {a: [(1.0, 0, 0.0, True)] for a in (0, 1)}},  # leads to the start
        {s: {a: [(0.5, *x[0][1:])] * 2 for a, x in row.items()} for s, row in ROWS.items()},
    ],
)
def test_tables_that_say_the_same_are_one_model(
    table: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A corridor of three cells that ends at the last one."""
    shown(table, monkeypatch)
    model, starts = read_model("Corridor", {}, 0.9)
    assert model.terminal.tolist() == [False, False, True]
    assert starts.tolist()[0] == 0
    for s, a in product(range(2), range(2)):
        likely = model.probability[s, a] > 0
        assert {*model.successor[s, a][likely]} == {max(s + 2 * a - 1, 0)}
        assert model.probability[s, a].sum() == 1


@pytest.mark.parametrize(
    "table",
    [
        {"a": {0: [(1.0, "a", 0.0, True)]}},
        {(0, 1): {0: [(1.0, (0, 1), 0.0, True)]}},
        {-1: {0: [(1.0, 0, 0.0, True)]}},
        {0: {0: [(1.0, 0, 0.0)]}},
        {0: [(1.0, 0, 0.0, True)]},
        {},
        {"0": {0: [(1.0, 0, 0.0, True)]}},
        {0.5: {0: [(1.0, 0, 0.0, True)]}},
        {0: {0: [(0.5, 0, 0.0, True)]}},
        {0: {0: [(1.5, 0, 0.0, True), (-0.5, 0, 0.0, True)]}},
        {0: {0: [(1.0, 0.5, 0.0, True)]}},
        {0: {0: [(1.0, 0, float("nan"), True)]}},
        {0: {0: [(1.0, 1, 0.0, False)]}},  # on to a state without a row, and not at its end
    ],
)
def test_another_kind_of_model_is_refused_in_a_line(
    table: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown(table, monkeypatch)
    with refused(r"^domain\.id="):
        read_model("Other", {}, 0.9)


@pytest.mark.parametrize("error", [RuntimeError, ImportError, OSError, IndexError])
def test_an_environment_that_cannot_be_made_is_refused_in_a_line(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(*_: object, **__: object) -> None:
        raise error("no display\nsee the manual")

    monkeypatch.setattr("gymnasium.make", make)
    with pytest.raises(
        InputError, match=r"^domain\.id='Mine': gymnasium cannot make it: no display$"
    ):
        read_model("Mine", {}, 0.9)


def test_wrappers_that_change_what_is_observed_change_no_states() -> None:
    """The model is the inner environment's; the wrapper shows only the place."""
    gymnasium.register(
        "Shown-v0",
        entry_point=lambda: gymnasium.wrappers.TransformObservation(
            gymnasium.make("CliffWalking-v1"), lambda s: s % 12, gymnasium.spaces.Discrete(12)
        ),
    )
    (shown_model, starts), (own, expected) = (
        read_model(id, {}, 0.9) for id in ("Shown-v0", "CliffWalking-v1")
    )
    assert np.array_equal(shown_model.successor, own.successor)
    assert np.array_equal(starts, expected)


def test_an_end_that_depends_on_the_way_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = {0: [(1.0, 1, 0.0, True)], 1: [(1.0, 1, 0.0, False)]}
    shown({0: ways, 1: ways}, monkeypatch)
    parameters = {"x": {"inaccurate": [{"add": 1.0}], "message": "No."}}
    with pytest.raises(InputError, match="an end that depends on the state alone: state 1"):
        Gymnasium("Two", {"place": 2}, ["end", "go on"], 0.9, parameters)


def test_phrases_name_what_changes() -> None:
    taxi = domain_of("domain=taxi")
    state = int(np.ravel_multi_index((0, 0, 0, 1), (5, 5, 5, 4)))
    aboard = int(np.ravel_multi_index((0, 0, 4, 1), (5, 5, 5, 4)))
    pick_up = taxi.actions.index("pick up")
    assert taxi.describe(np.array([state, pick_up, aboard])) == "pick up: passenger red → taxi"
    assert taxi.describe(np.array([state, 1, state])) == "north: nothing changes"


def change(**fields: Any) -> dict[str, Any]:
    return {"parameters": {"x": {"inaccurate": [fields], "message": "Not so."}}}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"id": "NoSuchThing-v0"}, "gymnasium cannot make it"),
        ({"id": "CartPole-v1"}, "tabular model"),
        ({"arguments": {"colour": "red"}}, "gymnasium cannot make it"),
        ({"discount": 1}, r"\(0, 1\)"),
        ({"states": {"row": 4, "column": 11}}, "product must be 48"),
        ({"states": {"row": 4, "column": "twelve"}}, "how many values"),
        ({"states": {}}, "product must be 48"),
        ({"actions": ["up", "down"]}, "4 different names"),
        ({"actions": ["up", "down", "left", "left"]}, "4 different names"),
        ({"discount": 0}, r"\(0, 1\)"),
        ({"states": {"row": 4, "column": 12, "depth": 0}}, "how many values"),
        ({"starts": {"depth": 1}}, "unknown feature"),
        ({"starts": {"row": 7}}, "one of 0, 1, 2, 3"),
        ({"starts": {"row": 3, "column": 11}}, "at least one state that is not terminal"),
        ({"parameters": {}}, "at least one"),
        ({"parameters": ["wind"]}, "inaccurate, message"),
        ({"parameters": {"x": {"message": "Not so."}}}, "lacks inaccurate"),
        ({"parameters": {"x": {"inaccurate": "wet", "message": "No."}}}, "a list of changes"),
        ({"parameters": {"x": {"inaccurate": ["wet"], "message": "No."}}}, "a change with"),
        ({"parameters": {"x": {"inaccurate": [], "message": "No."}}}, "differs from accurate"),
        (change(when={"row": 0}), "one of add, like, to, arguments"),
        (change(add=1.0, like="up"), "one of add, like, to, arguments"),
        (change(add="much"), "finite number"),
        (change(add=1.0, where={}), "unknown"),
        (change(add=1.0, when={"row": 9}), "one of 0, 1, 2, 3"),
        (change(add=1.0, next=3), "feature: value"),
        (change(add=1.0, actions="up"), "a list of actions"),
        (change(add=1.0, actions=["jump"]), "unknown action"),
        (change(like="jump"), "unknown action"),
        (change(like="up", next={"row": 0}), "next needs add"),
        (change(to={"row": 9}), "one of 0, 1, 2, 3"),
        (change(to=3), "feature: value"),
        (change(arguments={"is_slippery": True}, when={}), "no other field"),
        (change(arguments={"colour": "red"}), "gymnasium cannot make it"),
        (change(arguments="slippery"), "argument: value"),
        ({"parameters": {"x": {"inaccurate": [], "message": "No.", "why": 1}}}, "unknown field"),
    ],
)
def test_bad_input_is_one_clear_line(changes: dict[str, Any], text: str) -> None:
    with refused(text, "domain."):
        Gymnasium(**given("cliff_walking") | changes)


def test_without_gymnasium_the_error_names_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = given("cliff_walking")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(XplainError, match=r"pip install 'xplain-hri\[gym\]'"):
        Gymnasium(**arguments)
