"""The service's task: its user types, its questions, and its map.

configuration ── served ── explanations and questionnaires (talks.py)
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import Domain, transition_features
from xplain.domains.users.hypotheses import Hypotheses
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError
from xplain.experiment.from_config import component
from xplain.experiment.pipeline import draw_trace
from xplain.explanation.asking import Limits, nearest_first
from xplain.explanation.message_sets import mask_of
from xplain.interaction.explainer import Explainer
from xplain.interaction.session import Candidate, Session
from xplain.learning.saved import LearnedTypes
from xplain.people.material import learn_domain_types
from xplain.questions.own_transitions import read_known_facts, with_features
from xplain.questions.questionnaire import Questionnaire
from xplain.randomness import run_seed
from xplain.storage import encode

Transition = int | Sequence[float] | Mapping[str, float | str]
"""An index into the task's transitions, its features in order, or its columns by name."""
PLANS = 100
"""Maximum number of traces whose plans are kept for new sessions."""
TRACES = 5
"""Number of traces of a domain's robot that a page can show."""


@dataclass(frozen=True)
class ServedTask:
    """The task that a service explains and asks about.

    Attributes:
        explainer: explains to people of the types.
        types: the learned types.
        hypotheses: T transitions with features, and the sets of facts that people may believe
            incorrectly; None if the service only explains traces that callers send.
        sentences: {name of a message: its text}.
        beliefs: {name of a message: what a person says who believes the message's fact
            incorrectly}.
        seed: seed that breaks ties in questionnaires.
        questions: maximum number of questions in a questionnaire.
        asking: keyword arguments of each :class:`xplain.questions.questionnaire.Questionnaire`.
        clips: maximum number of transitions that an explanation may ask about.
        scene: a domain's map, or None.
        cells: [T, 2] the map's cells where each transition starts and ends.
        traces: traces of the domain's robot, each a sequence of indices of transitions.
    """

    explainer: Explainer
    types: LearnedTypes
    hypotheses: Hypotheses | None
    sentences: Mapping[str, str]
    beliefs: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    questions: int = 20
    asking: Mapping[str, Any] = field(default_factory=dict)
    clips: int = 0
    scene: Any = None
    cells: tuple[tuple[Any, Any], ...] = ()
    traces: tuple[tuple[int, ...], ...] = ()

    @cached_property
    def features(self) -> NDArray[np.float64]:
        """[T, F] features of the T transitions; the F columns are ordered as
        ``types.feature_names``."""
        known = self.hypotheses
        if known is None or known.features is None:
            return np.empty((0, len(self.types.feature_names)))
        columns = [known.feature_names.index(name) for name in self.types.feature_names]
        return known.features[:, columns]

    @cached_property
    def questionnaire(self) -> Questionnaire:
        """A new questionnaire without answers.

        Raises:
            InputError: there are no hypotheses.
        """
        if self.hypotheses is None:
            wanted = "a service that was started with domain=, transitions= or hypotheses="
            raise InputError("questionnaires", "none", wanted)
        return Questionnaire(self.hypotheses, **self.asking)

    def row(self, transition: Transition) -> list[float]:
        """Returns the features of a transition.

        Args:
            transition: the transition's index, its features in order, or its features as {column:
                value}.

        Raises:
            InputError: the transition does not exist.
        """
        names, count = self.types.feature_names, len(self.features)
        if isinstance(transition, Mapping):
            return list(self.types.encode(transition))
        if isinstance(transition, int) and 0 <= transition < count:
            return [float(value) for value in self.features[transition]]
        if isinstance(transition, int) or len(transition) != len(names):
            allowed = f"a number below {count}, {len(names)} features, or columns by name"
            raise InputError("trace", transition, allowed)
        return list(transition)

    def session(self, trace: Sequence[Sequence[float]], expected_steps: int) -> Session:
        """Begins to explain a trace to a new person. All people with the same trace share one
        plan."""
        return self._sessions(tuple(map(tuple, trace)), expected_steps).restart()

    @cached_property
    def _sessions(self) -> Callable[[tuple[tuple[float, ...], ...], int], Session]:
        @lru_cache(PLANS)
        def session(trace: tuple[tuple[float, ...], ...], expected_steps: int) -> Session:
            rows = [list(row) for row in trace]
            return self.explainer.session(rows, expected_steps, self.candidates(rows))

        return session

    def candidates(self, trace: Sequence[Sequence[float]]) -> tuple[Candidate, ...]:
        """Lists the transitions that may be asked about while a trace is explained; transitions
        near the trace come first."""
        if not trace:
            return ()
        order = nearest_first(self.features, np.array(trace))[: self.clips].tolist()
        return tuple(Candidate(self.features[t].tolist(), self.text(t)) for t in order)

    def text(self, transition: int) -> str:
        """Describes the robot's action in a transition."""
        phrases = () if self.hypotheses is None else self.hypotheses.phrases
        return phrases[transition] if phrases else f"transition {transition}"

    def say(self, messages: Sequence[str]) -> list[str]:
        """Returns the sentences of messages."""
        return [self.sentences[name] for name in messages]

    def labels(self, wrong: Sequence[str], given: Sequence[str]) -> list[int]:
        """Returns [T], the labels of a person who believes the facts ``wrong`` incorrectly and
        received the messages ``given``.

        Raises:
            InputError: a fact does not exist.
        """
        known = self.questionnaire.hypotheses
        held = mask_of(wrong, known.messages, "wrong") & ~mask_of(given, known.messages, "given")
        found: list[int] = known.labels[known.row(np.array(held))].tolist()
        return found

    @cached_property
    def description(self) -> dict[str, Any]:
        """The task in plain JSON, for pages."""
        cells = self.cells or ((None, None),) * len(self.features)
        return {
            "messages": self.sentences,
            "beliefs": self.beliefs,
            "types": self.types.names,
            "features": self.types.feature_names,
            "transitions": [
                {"number": t, "text": self.text(t), "from": start, "to": end}
                for t, (start, end) in enumerate(cells)
            ],
            "traces": self.traces,
            "scene": None if self.scene is None else encode(self.scene),
        }


def make_served(cfg: DictConfig) -> ServedTask:
    """Makes the task of a configuration (conf/serve.yaml).

    Raises:
        XplainError: a file or a value cannot be used.
    """
    run_seed(cfg.seed)
    domain = component(cfg, "domain") if cfg.types is None else None
    found, _, said = read_known_facts(cfg.transitions, cfg.hypotheses, domain)
    known = found and with_features(found)
    types = LearnedTypes.load(cfg.types) if domain is None else learn_domain_types(cfg, domain)[1]
    if known is not None and {*known.feature_names} != {*types.feature_names}:
        wanted = f"transitions with the columns {', '.join(types.feature_names)}"
        raise InputError("transitions", ", ".join(known.feature_names), wanted)
    facts = () if domain is None else domain.parameters
    sentences = {fact.name: fact.message for fact in facts} or said or types.sentences
    explainer = Explainer(
        types,
        component(cfg, "solver"),
        cfg["lambda"],
        cfg.message_cost,
        cfg.inexplicability_cost,
        cfg.discount,
        cfg.discount_per,
        seed=cfg.seed,
        ask=Limits(cfg.ask.cost, cfg.ask.most, cfg.ask.when) if cfg.ask.kinds else None,
    )
    shown = {} if domain is None or known is None else _make_map(domain, known, cfg)
    return ServedTask(
        explainer,
        types,
        known,
        {name: sentences.get(name) or name for name in types.messages},
        {fact.name: fact.belief for fact in facts},
        cfg.seed,
        cfg.questions,
        {"error": cfg.error, "stop": cfg.stop},
        cfg.ask.clips if cfg.ask.kinds else 0,
        **shown,
    )


def _make_map(domain: Domain, known: Hypotheses, cfg: DictConfig) -> dict[str, Any]:
    """Returns the map of a domain, and some traces of its robot as indices into the transitions of
    the hypotheses."""
    assert known.states is not None, "hypotheses of a domain know states"
    assert known.features is not None, "and features"
    cells = tuple((domain.position(a), domain.position(b)) for a, b in known.states.tolist())
    setting = Setting.build(domain, (UserType("everybody", {}),))
    number = {row.tobytes(): t for t, row in reversed([*enumerate(known.features)])}
    traces = []
    for index in range(TRACES):
        trace = draw_trace(setting, cfg.max_steps, cfg.seed, index)
        traces.append(tuple(number[r.tobytes()] for r in transition_features(domain, trace)))
    return {"scene": domain.scene, "cells": cells, "traces": tuple(traces)}
