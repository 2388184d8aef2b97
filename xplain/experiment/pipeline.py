"""The first half of the method: observe, learn the user types, draw the traces.

    Setting ── Dataset ── UserTypes ── Case (one for each trace)

Its result is plain data and the same for every solver and λ, so a sweep does this work once. The
second half, Problem ── Policy ── Episode, is in :mod:`xplain.experiment.explanations`. Each stage
is one function, which commands and the study also call.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain, Scene, changes_of, transition_features
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import TypeSource
from xplain.errors import Count, DomainError, InputError, Range, checks
from xplain.experiment.asking import CaseQuestions, QuestionsOf, prepare_questions
from xplain.experiment.progress import SILENT, Progress
from xplain.explanation.asking import Pool
from xplain.explanation.label_table import LabelTable
from xplain.interaction.explainees import Explainee
from xplain.learning.data.observers import Observations, Observers
from xplain.learning.data.queries import Queries, sample_trace
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.types import KnownTypes, TablesOf, TraceTables
from xplain.learning.user_types import TypeFinder, find_types
from xplain.randomness import MOST, stream


@checks()
@dataclass(frozen=True)
class Components:
    """The components that decide the data, the types and the traces, but no explanation.

    Attributes:
        domain, users, observers, queries, labeler, clusterer: chosen in the configuration.
        traces: number of traces to explain.
        max_steps: a trace ends at a terminal state or after this number of steps.
        seed: seed of every stream.
        ask: possible questions in an explanation; None for no questions.
    """

    domain: Domain
    users: TypeSource
    observers: Observers
    queries: Queries
    labeler: LabelerTrainer
    clusterer: TypeFinder
    traces: Count
    max_steps: Count
    seed: Annotated[int, Range(0, MOST)]
    ask: Pool | None = None


@dataclass(frozen=True, kw_only=True)
class Case(TraceTables):
    """One trace, with its labels by every labeler and by every true type.

    Attributes:
        transitions: [m, 3].
        phrases: m short descriptions.
        positions: m + 1 cells (row, column) of the robot; empty without a map.
        labels: true labels of each of the M true types.
        changes: effects of each transition, as short phrases; empty if the domain describes none.
        questions: the questions that may be asked; None for no questions.
    """

    transitions: NDArray[np.int64]
    phrases: tuple[str, ...]
    positions: tuple[tuple[int, int], ...]
    labels: LabelTable
    changes: tuple[tuple[str, ...], ...] = ()
    questions: CaseQuestions | None = None


@dataclass(frozen=True, kw_only=True)
class PreparedData(KnownTypes):
    """All data before a solver and λ are chosen: the types that agents know, and the traces.

    Attributes:
        domain: name of the domain.
        messages: n names.
        sentences: n sentences, the text of each message.
        types: M names of the true types.
        distinct: [M] a number for each true type; types with the same number behave alike.
        scene: the map, if there is one.
        cases: one for each trace.
    """

    domain: str
    messages: tuple[str, ...]
    sentences: tuple[str, ...]
    types: tuple[str, ...]
    distinct: NDArray[np.int64]
    scene: Scene | None
    cases: tuple[Case, ...]


def prepare(components: Components, progress: Progress = SILENT) -> PreparedData:
    """Builds the setting, collects labels from observers, finds the types and learns their
    labelers.

    Raises:
        XplainError: the configuration or the data cannot be used; the text says what to change.
    """
    domain, seed = components.domain, components.seed
    observed = observe(domain, components.users, components.observers, components.queries, seed)
    setting = observed.setting
    assert setting is not None
    known, tables = find_types(observed, components.labeler, components.clusterer, seed)
    traces = progress.track(range(components.traces), "labelling traces", components.traces)
    pool = components.ask
    ask = None if pool is None else prepare_questions(setting, tables, pool, known.wrong, seed)
    return PreparedData(
        **vars(known),
        domain=domain.name,
        messages=setting.message_names,
        sentences=tuple(parameter.message for parameter in domain.parameters),
        types=tuple(user_type.name for user_type in setting.types),
        distinct=setting.distinct,
        scene=domain.scene,
        cases=tuple(
            build_case(
                setting,
                draw_trace(setting, components.max_steps, seed, index),
                tables,
                ask,
            )
            for index in traces
        ),
    )


def observe(
    domain: Domain, users: TypeSource, observers: Observers, queries: Queries, seed: int
) -> Observations:
    """Draws the true types, and collects labels from observers of these types. Returns the setting
    with the types, and the labels.

    Raises:
        XplainError: the types do not fit the domain, or the labels cannot be used.
    """
    types = users.types(domain, stream(seed, "users"))
    setting = Setting.build(domain, types)
    return observers.collect(setting, queries, seed)


def draw_trace(setting: Setting, max_steps: int, seed: int, index: int) -> NDArray[np.int64]:
    """Draws the trace [m, 3] with the number ``index``. It begins in a random start state and
    follows the robot's policy."""
    rng = stream(seed, "traces", index)
    return sample_trace(setting.models[0], setting.domain.starts, rng, max_steps)


def build_case(
    setting: Setting,
    transitions: NDArray[np.int64],
    tables: TablesOf,
    ask: QuestionsOf | None = None,
) -> Case:
    """Collects all data about one trace.

    Args:
        setting: has the true types.
        transitions: [m, 3] the trace.
        tables: computes labels by all labelers.
        ask: selects the questions that may be asked; None for no questions.
    """
    domain = setting.domain
    features = transition_features(domain, transitions)
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    cells = [domain.position(state) for state in states]
    return Case(
        transitions=transitions,
        phrases=tuple(domain.describe(transition) for transition in transitions),
        positions=tuple(cell for cell in cells if cell is not None),
        questions=ask and ask(features),
        changes=changes_of(domain, transitions),
        labels=setting.true_labels(transitions),
        **vars(tables(features, transitions)),
    )


def with_others(
    prepared: PreparedData, components: Components, explainee: Explainee
) -> PreparedData:
    """Returns the same learned types and traces, with users of other types (``Explainee.others``).
    There are as many users as true types, if enough other types differ from every true type and
    from each other.

    Fields that need observers of a true type are empty: the oracle's labels, and the matching
    learned type.

    Raises:
        InputError: all other types behave like the true types.
    """
    domain, seed = components.domain, components.seed
    observed = components.users.types(domain, stream(seed, "users"))
    others = explainee.others(domain, observed, stream(seed, "explainee", "strangers"))
    setting = Setting.build(domain, (*observed, *(t for t in others if _is_solvable(domain, t))))
    alike = setting.distinct.tolist()
    new = [t for t in range(len(observed), len(alike)) if alike[t] not in alike[:t]]
    new = new[: len(observed)]
    if not new:
        name = type(explainee).__name__
        raise InputError(
            "explainee", name, "a domain in which such users differ from the true types"
        )
    return replace(
        prepared,
        types=tuple(setting.types[t].name for t in new),
        distinct=len(alike) + np.arange(len(new)),
        cases=tuple(
            replace(
                case,
                perfect=None,
                labels=setting.true_labels(case.transitions).of_types(new),
                questions=case.questions and case.questions.of_users(setting, new),
            )
            for case in prepared.cases
        ),
    )


def _is_solvable(domain: Domain, user_type: UserType) -> bool:
    """True if the task can be solved under the type's beliefs."""
    with suppress(DomainError):
        Setting.build(domain, (user_type,))
        return True
    return False
