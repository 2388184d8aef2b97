"""The demo's session, from the configuration to its last step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hydra.utils import instantiate

from xplain.errors import InputError, one_of
from xplain.experiment.config import compose_config
from xplain.experiment.explanations import Costs, true_thoughts
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Case, PreparedData, prepare
from xplain.experiment.results import domain_name
from xplain.explanation.asking import Question
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.label_table import join_steps
from xplain.explanation.message_sets import mask_of
from xplain.interaction.explainees import Explainee, SimulatedUser
from xplain.interaction.explainer import Explainer, GivenTypes
from xplain.interaction.session import Candidate, Session, Why
from xplain.randomness import derive_seed, stream
from xplain.solvers.base import Solver


@dataclass(frozen=True)
class DemoSetup:
    """The data before the first step.

    Attributes:
        domain, solver: their names.
        prepared: the learned types, and the traces.
        case: the trace that is explained.
        explainer: explains to users of the learned types.
        explainee: how simulated users behave.
        beliefs: for each true type by name, its incorrect beliefs as sentences.
        trade_off: λ.
        suggested: true type of the most instructive simulated user.
        chosen: a sentence that says which trace was chosen and why; "" if the caller chose it.
    """

    domain: str
    solver: str
    prepared: PreparedData
    case: Case
    explainer: Explainer
    explainee: Explainee
    beliefs: dict[str, tuple[str, ...]]
    trade_off: float
    suggested: str
    chosen: str = ""

    def session(self, explainer: Explainer | None = None) -> Session:
        """Makes a session that explains the trace to a new user.

        Args:
            explainer: explains the trace; None takes the attribute ``explainer``.
        """
        steps, asked = len(self.case.transitions), self.case.questions
        explainer = explainer or self.explainer
        if asked is None or explainer.ask is None:
            return explainer.session(range(steps))
        told = zip(asked.texts, asked.right.tolist(), strict=True)
        clips = [Candidate(steps + q, *words) for q, words in enumerate(told)]
        return explainer.session(range(steps), clips=clips)

    def user_type(self, name: str | None) -> str:
        """Returns the name of a true type after checking it; None becomes the suggested type.

        Raises:
            InputError: the type does not exist.
        """
        return self.suggested if name is None else one_of("--user", name, self.beliefs)

    def right(self, user: str) -> list[str]:
        """Lists the names of the learned types that match a true type. The list is empty if there
        is only one learned type.

        Args:
            user: name of the true type.
        """
        prepared, found = self.prepared, self.explainer.types.names
        if len(found) < 2:
            return []
        alike = prepared.distinct[prepared.types.index(user)]
        return [
            name for name, of in zip(found, prepared.matched_true_type, strict=True) if of == alike
        ]

    def title(self, learned: str) -> str:
        """Makes a readable name of a learned type. It contains the names of the true types that
        match it, if these are known."""
        prepared = self.prepared
        number = dict(zip(prepared.learned_types, prepared.matched_true_type, strict=True))
        alike = prepared.distinct == number.get(learned, -1)
        names = [name for name, same in zip(prepared.types, alike, strict=True) if same]
        own = learned.replace("_", " ")
        return own if not names or own in names else f"{'/'.join(names)} ({own})"


@dataclass(frozen=True)
class Step:
    """One step: the messages, the reason for them, and the user's labels.

    Attributes:
        said: names of the messages given before the transition was shown.
        why: values of the possible actions.
        labels: labels of all transitions shown so far, 1 = explicable.
        belief: belief in each learned type, after the labels.
        cost: the cost of the paper's Definition 2 so far, and κ for each question.
        asked: questions before the messages, with the user's answers.
    """

    said: tuple[str, ...]
    why: Why
    labels: tuple[int, ...]
    belief: dict[str, float]
    cost: float
    asked: tuple[tuple[Question, int], ...] = ()


@dataclass(frozen=True)
class PlayedSession:
    """A session from beginning to end.

    Attributes:
        user: true type of the user.
        prior: belief before the first step.
        steps: one for each transition.
    """

    user: str
    prior: dict[str, float]
    steps: tuple[Step, ...]


TRIED = 5
"""Number of traces from which the most instructive one is chosen."""
SURE = 0.9
"""A type counts as found above this belief."""


def set_up(
    overrides: Sequence[str], trace: int | None = None, user: str | None = None
) -> DemoSetup:
    """Learns the user types as an experiment does, and chooses a trace.

    Args:
        overrides: overrides of the experiment's configuration.
        trace: number of the trace; None chooses the most instructive of the first five.
        user: true type for which the trace is chosen; None allows any type.

    Raises:
        XplainError, HydraException, OmegaConfBaseException: an override is wrong.
    """
    count = TRIED if trace is None else trace + 1
    cfg = compose_config("config", [*overrides, f"traces={count}"], with_hydra=True)
    choices = cfg.hydra.runtime.choices
    components, costs = components_of(cfg), costs_of(cfg)
    solver, update = instantiate(cfg.solver), instantiate(cfg.belief)
    explainee = instantiate(cfg.explainee)
    if solver.knows not in ("types", "everyone"):
        raise InputError("solver", str(choices.solver), "a solver that needs no user type")
    prepared = prepare(components)
    true_types = components.users.types(components.domain, stream(components.seed, "users"))
    sentence = {p.name: p.belief or f"({p.name} wrong)" for p in components.domain.parameters}
    beliefs = {t.name: tuple(sentence[fact] for fact in t.inaccurate) for t in true_types}
    cases = prepared.cases if trace is None else prepared.cases[trace:]
    stages = [
        DemoSetup(
            domain=domain_name(choices, cfg),
            solver=str(choices.solver),
            prepared=prepared,
            case=case,
            explainer=_make_explainer(prepared, case, costs, solver, update, components.seed),
            explainee=explainee,
            beliefs=beliefs,
            trade_off=costs.trade_off,
            suggested=name,
        )
        for case in cases
        for name in prepared.types
    ]
    named = [one for one in stages if one.suggested == user]  # an unknown user is an error later
    best = max(named or stages, key=_rate_setup)
    return best if trace is not None else replace(best, chosen=_describe_choice(prepared, best))


def _describe_choice(prepared: PreparedData, best: DemoSetup) -> str:
    number = next(i for i, case in enumerate(prepared.cases) if case is best.case)
    return (
        f"This is trace {number} of the first {TRIED}: here the type of a simulated user is found "
        "with the fewest messages. --trace chooses another trace."
    )


def _rate_setup(scene: DemoSetup) -> tuple[bool, bool, int, float]:
    """Rates how instructive a session with the suggested user is; larger ratings are better.

    Returns:
        In the order of importance: True if the session finds the user's type; True if the robot
        gives a message; minus the number of messages; the final belief in the user's type.
    """
    played = play(scene, scene.suggested)
    belief = sum(played.steps[-1].belief[name] for name in scene.right(scene.suggested))
    messages = sum(len(step.said) for step in played.steps)
    return belief > SURE, messages > 0, -messages, belief


def _make_explainer(
    prepared: PreparedData,
    case: Case,
    costs: Costs,
    solver: Solver,
    update: BeliefUpdate,
    seed: int,
) -> Explainer:
    """Makes the explainer of one trace to users of the learned types.

    Raises:
        InputError: the solver plans with one labeler for all types, and that labeler is too large.
    """
    alone = solver.knows == "everyone"
    table = case.everyone if alone else case.learned
    asked = None if alone else case.questions
    if asked is not None:
        table = join_steps([case.learned, asked.learned])
    if table is None:
        raise InputError("solver", "baseline", "a solver that plans for types: solver=qmdp")
    types = GivenTypes(
        table,
        prepared.messages,
        ("everyone",) if alone else prepared.learned_types,
        prepared.type_shares if costs.prior == "observers" and not alone else (),
        prepared.habits,
    )
    return Explainer(
        types,
        solver,
        costs.trade_off,
        costs.message_costs(prepared.messages),
        costs.inexplicability_cost,
        costs.discount,
        costs.discount_per,
        update,
        seed,
        None if asked is None else costs.asking,
    )


def play(scene: DemoSetup, user: str) -> PlayedSession:
    """Plays the session to its end with a simulated user of a true type."""
    session, steps = scene.session(), list[Step]()
    prior, asked = session.belief, list[tuple[Question, int]]()
    person, messages = _make_person(scene, user), scene.prepared.messages
    while not session.finished:
        move, given = session.next(), mask_of(session.said, messages)
        if isinstance(move, Question):
            about = len(scene.case.transitions) + move.number
            asked.append((move, person.answer(about, given)))
            session.answer(asked[-1][1])
        else:
            said = move.messages
            person.hear(mask_of(said, messages))
            given = mask_of(session.said, messages)
            labels = tuple(map(int, person.react(given, session.shown).answers))
            session.observe(labels)
            belief, cost = session.belief, session.cost
            steps.append(Step(said, session.why(), labels, belief, cost, tuple(asked)))
            asked = []
    return PlayedSession(user, prior, tuple(steps))


def _make_person(scene: DemoSetup, user: str) -> SimulatedUser:
    truth, same = true_thoughts(scene.case)
    labels = truth.of_types([scene.prepared.types.index(user)])
    seed = derive_seed(scene.explainer.seed, "explainee", user)
    return scene.explainee.meet(labels, same, seed)
