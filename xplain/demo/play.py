"""The session that the demo plays: from the configuration to every step of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from hydra.utils import instantiate

from xplain.config import composed
from xplain.errors import InputError
from xplain.evaluation.episode import SimulatedUser
from xplain.experiment.from_config import components_of, costs_of
from xplain.experiment.pipeline import Case, Prepared, prepare
from xplain.message_sets import mask_of
from xplain.randomness import stream
from xplain.sessions.explainer import Explainer, GivenTypes
from xplain.sessions.session import Session, Why


@dataclass(frozen=True)
class Stage:
    """What is fixed before the first word.

    Attributes:
        domain, solver: their names.
        prepared: the types that were learned, and the traces.
        case: the trace that is explained.
        explainer: of the learned types.
        beliefs: for each true type by name, what it believes wrongly, as sentences.
        trade_off: λ.
        drawn: the true type that the seed chooses for a simulated user.
    """

    domain: str
    solver: str
    prepared: Prepared
    case: Case
    explainer: Explainer
    beliefs: dict[str, tuple[str, ...]]
    trade_off: float
    drawn: str

    def user_type(self, name: str | None) -> str:
        """A true type by name; None takes the one that the seed chose.

        Raises:
            InputError: there is no such type.
        """
        if name is None:
            return self.drawn
        if name not in self.beliefs:
            raise InputError("--user", name, f"one of {', '.join(self.beliefs)}")
        return name

    def right(self, user: str | None) -> list[str]:
        """The learned types that stand for a true one; none for a person, or where all are one."""
        prepared, found = self.prepared, self.explainer.types.names
        if user is None or len(found) < 2:
            return []
        alike = prepared.distinct[prepared.types.index(user)]
        return [
            name for name, of in zip(found, prepared.matched_true_type, strict=True) if of == alike
        ]


@dataclass(frozen=True)
class Step:
    """One step: what the robot said, why, and what the user made of it.

    Attributes:
        said: messages given before the transition was shown, by name.
        why: the values behind them.
        labels: of every transition shown so far, 1 = explicable.
        belief: in each learned type, after the labels.
        cost: Definition 2 up to here.
    """

    said: tuple[str, ...]
    why: Why
    labels: tuple[int, ...]
    belief: dict[str, float]
    cost: float


@dataclass(frozen=True)
class Played:
    """A session from beginning to end.

    Attributes:
        user: the true type of the user; None for a person.
        prior: the belief before the first step.
        steps: one a transition.
    """

    user: str | None
    prior: dict[str, float]
    steps: tuple[Step, ...]


class Audience(Protocol):
    """Whoever is told of a session as it is played."""

    def said(self, session: Session) -> None:
        """The robot has said its messages and shown its transitions."""
        ...

    def heard(self, step: Step) -> None:
        """The user has answered."""
        ...


Answer = Callable[[Session], Sequence[int]]
"""The user's labels of the transitions that a session shows."""


def stage(overrides: Sequence[str], trace: int) -> Stage:
    """Learns the user types as an experiment does, and takes one of its traces.

    Raises:
        XplainError, HydraException, OmegaConfBaseException: something in ``overrides`` is wrong.
    """
    cfg = composed("config", [*overrides, f"traces={trace + 1}"], with_hydra=True)
    choices = cfg.hydra.runtime.choices
    components, costs = components_of(cfg), costs_of(cfg)
    solver, update = instantiate(cfg.solver), instantiate(cfg.belief)
    if solver.knows not in ("types", "everyone"):
        raise InputError("solver", str(choices.solver), "one that need not know the user's type")
    prepared = prepare(components)
    case = prepared.cases[trace]
    alone = solver.knows == "everyone"
    table = case.everyone if alone else case.learned
    if table is None:
        raise InputError("solver", str(choices.solver), "one that plans for types: solver=qmdp")
    types = GivenTypes(
        table,
        prepared.messages,
        ("everyone",) if alone else prepared.learned_types,
        prepared.type_shares if costs.prior == "observers" and not alone else (),
    )
    true_types = components.users.types(components.domain, stream(components.seed, "users"))
    sentence = {p.name: p.belief or f"({p.name} wrong)" for p in components.domain.parameters}
    names = tuple(user_type.name for user_type in true_types)
    return Stage(
        domain=str(choices.domain),
        solver=str(choices.solver),
        prepared=prepared,
        case=case,
        explainer=Explainer(
            types,
            solver,
            costs.trade_off,
            costs.message_costs(prepared.messages),
            costs.inexplicability_cost,
            costs.discount,
            costs.discount_per,
            update,
            components.seed,
        ),
        beliefs={t.name: tuple(sentence[fact] for fact in t.inaccurate) for t in true_types},
        trade_off=costs.trade_off,
        drawn=names[int(stream(components.seed, "demo").integers(len(names)))],
    )


def play(scene: Stage, answer: Answer, audience: Audience | None = None) -> Played:
    """Plays the session to its end."""
    session = scene.explainer.session(range(len(scene.case.transitions)))
    prior, steps = session.belief, []
    while not session.finished:
        said = session.messages()
        if audience is not None:
            audience.said(session)
        labels = answer(session)
        session.observe(labels)
        steps.append(
            Step(said, session.why(), tuple(map(int, labels)), session.belief, session.cost)
        )
        if audience is not None:
            audience.heard(steps[-1])
    return Played(getattr(answer, "user", None), prior, tuple(steps))


@dataclass(frozen=True)
class Simulated:
    """Answers as a simulated user of a true type, by its true labels."""

    scene: Stage
    user: str

    def __call__(self, session: Session) -> Sequence[int]:
        prepared = self.scene.prepared
        user = SimulatedUser(self.scene.case.labels[prepared.types.index(self.user)])
        said = mask_of(session.said, prepared.messages)
        labels: list[int] = user.labels(session.shown, said).tolist()
        return labels


def asked(terminal: Any) -> Answer:
    """Answers as the person at the terminal does."""

    def answer(session: Session) -> Sequence[int]:
        labels: Sequence[int] = terminal.ask(session.shown)
        return labels

    return answer
