"""Each fault of a component fails the suite's test about it; random problems have what has revealed
errors."""

import itertools
from dataclasses import dataclass, replace
from inspect import signature

import numpy as np
import pytest

from xplain import Clustering, LabelerTrainer, Parameter, Setting, UserType
from xplain.explanation.actions import EXPLAIN, GiveMessages, give
from xplain.interaction.explainees import Exact, Reaction
from xplain.learning.data.queries import Independent
from xplain.learning.user_types import Single, UserTypes
from xplain.solvers.greedy import QMDP
from xplain.testing import (
    Chosen,
    DomainConformance,
    ExplaineeConformance,
    LabelerConformance,
    PartitionConformance,
    QueriesConformance,
    SolverConformance,
    TypeFinderConformance,
    TypeSourceConformance,
)
from xplain.testing.data import rule_data
from xplain.testing.problems import random_problem, with_questions


class Wrapped:
    """A component whose parts can be replaced by faulty ones."""

    def __init__(self, whole, **faults):
        self._whole, self._faults = whole, faults

    def __getattr__(self, name):
        fault = self._faults[name] if name in self._faults else getattr(self._whole, name)
        if name in self._faults and callable(fault):
            return lambda *arguments: fault(self._whole, *arguments)
        return fault


@dataclass(frozen=True)
class Spoilt:
    """QMDP with another decision, ``decide(policy, problem, visible, belief)``."""

    decide: object = None
    values: object = None
    knows: str = "types"

    def plan(self, problem, seed=0):
        policy = QMDP().plan(problem, seed)
        faults = {
            name: (lambda whole, *a, fault=fault: fault(whole, problem, *a))
            for name, fault in (("decide", self.decide), ("values", self.values))
            if fault is not None
        }
        return Wrapped(policy, **faults)


def change_belief(policy, problem, visible, belief):
    belief[0] = 0.0
    return policy.decide(visible, belief)


def say_all(policy, problem, visible, belief):
    return give((1 << problem.n_messages) - 1 & ~visible.given)


counter = itertools.count()
RNG = np.random.default_rng(0)

SOLVERS = [
    ("is_a_solver", Spoilt(knows="everything")),
    ("exist_and_are_new", Spoilt(lambda p, x, v, b: GiveMessages(1 << x.n_messages))),
    ("exist_and_are_new", Spoilt(lambda p, x, v, b: give(v.given))),
    ("exist_and_are_new", Spoilt(lambda p, x, v, b: GiveMessages(-1))),
    ("exist_and_are_new", Spoilt(lambda p, x, v, b: ("m",))),
    ("same_question", Spoilt(lambda p, x, v, b: GiveMessages(next(counter)))),
    ("values_belong", Spoilt(values=lambda p, x, v, b: {EXPLAIN: float("nan")})),
    ("values_belong", Spoilt(values=lambda p, x, v, b: {GiveMessages(1 << x.n_messages): 0.0})),
    ("leaves_problem", Spoilt(change_belief)),
    ("leaves_problem", Spoilt(values=change_belief)),
    *(
        ("says_nothing", Spoilt(lambda p, x, v, b, at=at: GiveMessages(1) if at(x, v) else EXPLAIN))
        for at in (
            lambda x, v: x.n_steps == 1,
            lambda x, v: x.n_steps > 4 and v.step == 0,
            lambda x, v: x.n_steps > 1 and v.step == x.n_steps - 1,
        )
    ),
    *(
        ("says_at_once", Spoilt(lambda p, x, v, b, action=action: action))
        for action in (EXPLAIN, GiveMessages(1), GiveMessages(3))
    ),
    ("explains_a_whole", Spoilt(say_all)),
    ("explains_a_whole", Spoilt(lambda p, x, v, b: say_all(p, x, v, b) if v.step else EXPLAIN)),
]

rescue = Chosen("domain", "rescue").make()
idle = Parameter("weather", 0, 1, "It rains.")
rooms = Wrapped(
    Chosen("domain", "four_rooms").make(),
    model=lambda d, values: d.model({one.name: one.accurate for one in d.parameters}),
)


def count_wrong(values):
    return sum(values[one.name] != one.accurate for one in rescue.parameters)


STARTS, ENDS = (
    set(own)
    for own in Setting.build(rescue, (UserType("A", {rescue.parameters[0].name: -1.0}),))
    .reachable[:, [0, 2]]
    .T.tolist()
)
doubled = replace(rescue.parameters[0], message=" ")
DOMAINS = [
    ("is_a_domain", object()),
    ("named_and_told", Wrapped(rescue, parameters=(doubled, *rescue.parameters[1:]))),
    ("named_and_told", Wrapped(rescue, parameters=(*rescue.parameters, rescue.parameters[0]))),
    ("shares_states", Wrapped(rescue, actions=rescue.actions[:-1])),
    ("shares_states", Wrapped(rescue, actions=rescue.actions[:1] * len(rescue.actions))),
    ("shares_states", Wrapped(rescue, model=lambda d, v: (d, rooms)[count_wrong(v) > 1].model(v))),
    (
        "function_of_the_values",
        Wrapped(
            rescue,
            model=lambda d, values: replace(d.model(values), discount=0.9 + 1e-4 * next(counter)),
        ),
    ),
    (
        "function_of_the_values",
        Wrapped(
            rescue,
            model=lambda d, values: replace(
                d.model(values), reward=d.model(values).reward + next(counter)
            ),
        ),
    ),
    (  # the same until another model is made
        "function_of_the_values",
        Wrapped(
            rescue,
            model=lambda d, values, made=[0]: (
                made.append(count_wrong(values))
                or replace(d.model(values), discount=0.9 - 0.1 * max(made))
            ),
        ),
    ),
    ("features_describe", Wrapped(rescue, state_features=rescue.state_features[:-1])),
    ("features_describe", Wrapped(rescue, state_features=rescue.state_features * np.nan)),
    ("can_start", Wrapped(rescue, starts=np.array([10**6]))),
    ("message_can_matter", Wrapped(rescue, parameters=(*rescue.parameters, idle))),
    ("transitions_are_told", Wrapped(rescue, describe=lambda d, transition: "a\nb")),
    ("place_for_the_robot", Wrapped(rescue, position=lambda d, state: (99, 0))),
    ("place_for_the_robot", Wrapped(rescue, scene=None)),
    *(
        (
            "place_for_the_robot",
            Wrapped(rescue, position=lambda d, s, off=off: (-1, 0) if s in off else d.position(s)),
        )
        for off in (STARTS - ENDS, ENDS - STARTS)
    ),
]

first = rescue.parameters[0].name
SOURCES = [
    ("hold_parameters", lambda d, rng: ()),
    ("hold_parameters", lambda d, rng: (UserType("A", {}),)),
    ("hold_parameters", lambda d, rng: (UserType("A", {"lava": 1}),)),
    ("hold_parameters", lambda d, rng: (UserType("A", {first: -1}), UserType("A", {first: -2}))),
    ("same_stream", lambda d, rng: (UserType(str(next(counter)), {first: -1.0}),)),
    ("told_apart", lambda d, rng: tuple(UserType(n, {first: -1.0}) for n in "AB")),
]


def asks(
    wrong=lambda one, setting: one,
    sizes=lambda sizes: sizes,
    stream=lambda setting, seed: seed,
):
    """Independent questions with a fault: ``wrong(answered, setting)`` of each observer, other
    ``sizes`` than agreed, or another ``stream`` of the setting and the seed."""

    def ask(design, setting, agreed, answer, seed):
        asked = design.ask(setting, sizes(agreed), answer, stream(setting, seed))
        return [wrong(one, setting) for one in asked]

    return Wrapped(Independent(), ask=ask)


QUERIES = [
    ("no_more_than_agreed", asks(sizes=lambda sizes: sizes + 1)),
    ("no_more_than_agreed", asks(sizes=lambda sizes: sizes[1:])),
    ("no_more_than_agreed", asks(lambda one, _: replace(one, transitions=one.transitions[1:]))),
    ("no_more_than_agreed", asks(lambda one, _: replace(one, message_sets=one.message_sets[1:]))),
    ("answers_are", asks(lambda one, _: replace(one, labels=one.labels[::-1]))),
    ("answers_are", asks(lambda one, _: replace(one, labels=1 - one.labels))),
    ("answers_are", asks(lambda one, _: replace(one, message_sets=one.message_sets[::-1]))),
    ("answers_are", asks(lambda one, _: replace(one, transitions=one.transitions[::-1]))),
    # A transition that ends at its start, which no action of the robot does.
    (
        "what_the_robot_does",
        asks(lambda one, _: replace(one, transitions=one.transitions[:, [0, 1, 0]])),
    ),
    (
        "what_the_robot_does",
        asks(lambda one, s: replace(one, message_sets=one.message_sets | 1 << s.n_messages)),
    ),
    ("what_the_robot_does", asks(lambda one, _: replace(one, message_sets=-1 - one.message_sets))),
    ("same_seed", asks(stream=lambda setting, seed: next(counter))),
    (
        "true_types",
        asks(stream=lambda setting, seed: len(next(iter(setting.types[0].inaccurate)))),
    ),
]


def fits(data=lambda dataset: dataset, **faults):
    """A trainer that learns from other data, or whose labelers have faults."""
    return Wrapped(
        LabelerTrainer(),
        fit=lambda trainer, dataset, seed: Wrapped(trainer.fit(data(dataset), seed), **faults),
    )


def moody(dataset):
    noisy = dataset.label ^ (RNG.random(len(dataset)) < 0.2)
    return replace(dataset, label=noisy).take(np.arange(200))


SURE = fits(probability=lambda labeler, x, h: labeler.predict(x, h).astype(float))
IGNORANT = fits(predict=lambda labeler, x, h: np.ones(len(x), np.uint8))
LABELERS = [
    ("order_of_the_labels", fits(lambda dataset: dataset.take(np.arange(200)))),
    ("never_certain", SURE),
    ("table_says", SURE),
    ("plain_rule", IGNORANT),
    ("labels_follow", IGNORANT),
    ("same_seed", fits(moody)),
    *(("one_kind", fits(probability=lambda _, x, h, p=p: np.full(len(x), p))) for p in (0.3, 0.7)),
    ("figures", fits(moody)),
]


@dataclass(frozen=True)
class Clusters:
    """``assign(dataset, truth)``."""

    assign: object

    def find(self, observed, seed):
        found = Clustering(np.zeros(len(observed.dataset.observers), dtype=np.int64), "", "")
        assignment = np.asarray(self.assign(observed.dataset, observed.truth))
        object.__setattr__(found, "assignment", assignment)
        return UserTypes((), found, (), np.zeros(0))


def everybody(data, truth):
    return np.zeros(len(data.observers), dtype=int)


CLUSTERERS = [
    ("every_observer", Clusters(lambda d, t: everybody(d, t)[1:])),
    ("every_observer", Clusters(lambda d, t: everybody(d, t) + 1)),
    ("says_how", Clusters(everybody)),
    ("same_seed", Clusters(lambda d, t: RNG.integers(0, 9, len(d.observers)))),
    ("look_at_the_truth", Clusters(lambda d, t: everybody(d, t) if t is None else t)),
    ("plain_types", Clusters(everybody)),
    ("any_order", Clusters(lambda d, t: everybody(d, t) + np.arange(len(d.observers)) // 3)),
    ("answer_alike", Clusters(lambda d, t: np.arange(len(d.observers)))),
    ("each_type", Clusters(everybody)),
    *(
        (
            "each_type",
            Wrapped(Single(), find=lambda s, o, seed, wrong=wrong: wrong(s.find(o, seed))),
        )
        for wrong in (
            lambda types: replace(types, prior=types.prior / 2),
            lambda types: replace(
                types,
                labelers=[Wrapped(types.labelers[0], probability=lambda one, x, h: h == h)],
            ),
        )
    ),
    ("single_observer", Clusters(lambda d, t: np.array([5]))),
]


def groups(split):
    """A partition by ``split(vectors, k)``."""
    return Wrapped(None, partition=lambda _, vectors, k, seed: split(vectors, k))


PARTITIONS = [
    ("at_most_k", groups(lambda v, k: np.unique(v, axis=0, return_inverse=True)[1].ravel())),
    ("at_most_k", groups(lambda v, k: v[:, 0] * 0)),
    *(
        (
            "at_most_k",
            groups(
                lambda v, k, wrong=wrong, count=count: np.minimum(
                    np.unique(v, axis=0, return_inverse=True)[1].ravel(),
                    (count if k == wrong else k) - 1,
                )
            ),
        )
        for wrong, count in ((1, 2), (4, 3))
    ),
    ("stay_together", groups(lambda v, k: np.arange(len(v)) % k)),
    ("same_groups", groups(lambda v, k: RNG.integers(0, k, len(v)))),
    ("as_they_were", groups(lambda v, k: np.copyto(v, 0))),
]


def meets(hear=lambda person, new: person.hear(new), react=lambda person, k, out: out):
    """Makes the paper's users with a fault; ``react`` gets the first k transitions' reaction."""

    def meet(kind, labels, same, seed):
        def changed(person, given, shown):
            return Reaction(*react(person, shown, person.react(given, shown)))

        return Wrapped(kind.meet(labels, same, seed), hear=hear, react=changed)

    return Wrapped(Exact(), meet=meet)


EXPLAINEES = [
    ("zeros_and_ones", meets(react=lambda p, k, out: (out.thoughts[1:], out.answers))),
    ("zeros_and_ones", meets(react=lambda p, k, out: (out.thoughts, out.answers + 1))),
    ("same_person", meets(react=lambda p, k, out: (out.thoughts, RNG.integers(0, 2, k)))),
    (
        "same_person",
        meets(lambda p, new: np.copyto(p.table.p, RNG.integers(0, 2, p.table.p.shape))),
    ),
    ("stay_as_they", meets(react=lambda p, k, out: (p.table.p.fill(0), out.answers))),
]

FAULTS = [
    *((SolverConformance, test, c) for test, c in SOLVERS),
    *((DomainConformance, test, c) for test, c in DOMAINS),
    *(
        (TypeSourceConformance, test, Wrapped(None, types=lambda w, d, r, f=f: f(d, r)))
        for test, f in SOURCES
    ),
    *((QueriesConformance, test, c) for test, c in QUERIES),
    *((LabelerConformance, test, c) for test, c in LABELERS),
    *((TypeFinderConformance, test, c) for test, c in CLUSTERERS),
    *((PartitionConformance, test, c) for test, c in PARTITIONS),
    *((ExplaineeConformance, test, c) for test, c in EXPLAINEES),
]


@pytest.mark.parametrize(("suite", "about", "component"), FAULTS)
def test_a_fault_fails_the_test_that_is_about_it(suite, about, component):
    (name,) = (name for name in dir(suite) if name.startswith("test_") and about in name)
    fixtures = {"domain": rescue, "setting": Setting.build(rescue, (UserType("A", {first: -1.0}),))}
    test = getattr(suite(), name)
    given = {key: fixtures[key] for key in fixtures if key in signature(test).parameters}
    with pytest.raises((AssertionError, ValueError)):
        test(component=component, **given)


def test_every_promise_has_a_fault_that_breaks_it():
    suites = {suite for suite, _, _ in FAULTS}
    promises = {(s, name) for s in suites for name in dir(s) if name.startswith("test_")}
    broken = {(s, name) for s, about, _ in FAULTS for name in dir(s) if about in name}
    assert not promises - broken


def test_a_solver_is_asked_at_any_step_with_any_messages_and_beliefs() -> None:
    asked = []
    SolverConformance().test_gives_messages_that_exist_and_are_new(
        Spoilt(lambda policy, *situation: asked.append(situation) or EXPLAIN)
    )
    shares = [
        (
            seen.given == 0,
            seen.given == (1 << p.n_messages) - 1,
            seen.step == 0,
            seen.step == p.n_steps - 1,
            p.n_types == 3,
            np.isin(p.p_explicable, (0, 1)).all(),
        )
        for p, seen, _ in asked
    ]
    assert all(0.2 < share < 0.8 for share in np.mean(shares, axis=0))


def test_a_person_hears_each_message_once_and_sees_one_transition_more_at_each_step() -> None:
    said = []
    ExplaineeConformance().test_reacts_with_zeros_and_ones_to_all_that_is_shown(
        Wrapped(
            Exact(),
            meet=lambda kind, *about: Wrapped(
                kind.meet(*about),
                hear=lambda person, new: said.append(new),
                react=lambda person, *shown: said.append(shown) or person.react(*shown),
            ),
        )
    )
    assert said == [0, (0, 1), 1, (1, 2), 2, (3, 3), 4, (7, 4)]


def test_labels_follow_the_rule() -> None:
    """A type finds transition i inexplicable until message i mod 4, if it needs this message."""
    needs = [[0, 3], [], [2]]
    data, truth = rule_data(np.random.default_rng(0), needs, per_type=2, points=500)
    assert data.features.tolist() == [[i, i % 4] for i in range(10)]
    right = [
        int(kind not in needs[t] or given >> kind & 1)
        for t, kind, given in zip(
            data.observer // 2, data.transition % 4, data.message_set, strict=True
        )
    ]
    assert (truth.tolist(), data.label.tolist()) == ([0, 0, 1, 1, 2, 2], right)
    assert [  # all observers answer the same questions
        (len(np.unique(own.reshape(6, 500), axis=0)), len(np.unique(own)))
        for own in (data.transition, data.message_set)
    ] == [(1, 10), (1, 16)]


SOMETIMES = {
    "a message that costs nothing": (0.14, lambda p: (p.message_cost == 0).any()),
    "messages of unequal cost": (0.33, lambda p: len(set(p.message_cost)) > 1),
    "labels without a cost": (0.15, lambda p: p.inexplicability_cost == 0),
    "messages without a cost": (0.15, lambda p: p.trade_off == 0),
    "messages of high cost": (0.28, lambda p: p.trade_off > 4 / 3),
    "no discount": (0.3, lambda p: p.discount == 1),
    "a strong discount": (0.35, lambda p: p.discount < 0.5),
    "a discount for each action": (0.7, lambda p: p.discount_per == "action"),
    "certain labels": (0.25, lambda p: np.isin(p.p_explicable, (0, 1)).all()),
    "uncertain labels": (0.5, lambda p: not np.isin(p.p_explicable, (0, 1)).any()),
    "both together": (0.2, lambda p: 0 < np.isin(p.p_explicable, (0, 1)).mean() < 1),
    "one confidence": (
        0.25,
        lambda p: (
            np.ptp(np.abs(p.p_explicable - 0.5), axis=(1, 2)).max() < 1e-9
            and not np.isin(p.p_explicable, (0, 1)).any()
        ),
    ),
    "a type that nobody has": (0.2, lambda p: (p.prior == 0).any()),
    "a repeated transition": (
        0.25,
        lambda p: p.n_steps > 1 and np.ptp(p.p_explicable[:, [0, -1]], 1).max() == 0,
    ),
    "a message without effect": (
        0.15,
        lambda p: len(p.table.effective_of_any()) < p.n_messages,
    ),
    "several types": (0.83, lambda p: p.n_types > 1),
    "users who err": (0.33, lambda p: not p.habits.never_err),
    "users who always err": (0.17, lambda p: p.habits.error.min() > 0),
    "several questions": (0.39, lambda p: p.questions.limits.most > 1),
    "certain questions": (0.5, lambda p: np.isin(p.questions.table.p, (0, 1)).all()),
    "similar questions": (
        0.17,
        lambda p: (
            len(p.questions) > 1
            and (p.questions.table.p[:, -1] == p.questions.table.p[:, 0] ** 2).all()
        ),
    ),
    "questions at the beginning": (0.3, lambda p: p.questions.limits.when == "first"),
    "a question that costs nothing": (0.15, lambda p: p.questions.limits.cost == 0),
}


def test_random_problems_have_what_has_revealed_errors() -> None:
    rng = np.random.default_rng(0)
    drawn = [with_questions(rng, random_problem(rng)) for _ in range(300)]
    for what, (share, has) in SOMETIMES.items():
        assert abs(np.mean([has(problem) for problem in drawn]) - share) < 0.08, what
    assert {(p.n_user_types, p.n_steps, p.n_messages) for p in drawn} == {
        *itertools.product((1, 2, 3), (1, 2, 3), (0, 1, 2))
    }
    assert {len(p.questions) for p in drawn} == {1, 2, 3}
    assert {rate for p in drawn for rate in p.habits.error} == {0.0, 0.1, 0.3}
    for p in drawn:
        costs = [*p.message_cost, p.trade_off, p.inexplicability_cost, 8 * p.questions.limits.cost]
        assert 0 <= min(costs) <= max(costs) < 2
        assert all(((own.p >= 0) & (own.p <= 1)).all() for own in (p.table, p.questions.table))
        assert bool(p.questions.table.answers.size) == (not p.habits.never_err)
        likely = (p.table.answered > 0.5) == (
            p.table.p > 0.5
        )  # a certain label is the likely answer
        assert likely[np.isin(p.table.p, (0, 1))].all()
    assert all(random_problem(rng, max_types=1).habits.never_err for _ in range(20))
