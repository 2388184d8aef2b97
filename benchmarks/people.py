"""Simulated people who are not as the hypotheses assume, for benchmarks/questions.py.

``python benchmarks/questions.py labels`` prints how many of their labels differ, by kind.

Kinds differ in the incorrect values that user types believe, in the facts that hypotheses leave
out, or in the way people answer; they do not depend on any method. Types are drawn as for people
who are as assumed, so that all kinds of one seed believe the same facts incorrectly.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain import Hypotheses
from xplain.domains.base import Domain, Parameter
from xplain.domains.users.hypotheses import hypotheses_of
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import RandomCover
from xplain.errors import XplainError
from xplain.explanation.message_sets import indices
from xplain.learning.data.queries import Answer, Queries
from xplain.randomness import stream

AS_ASSUMED = "as assumed"
BY_A_VARIANT = ("half", "double")
"""Kinds that are not as assumed, but that a variant of the hypotheses fits exactly."""
OTHER_VALUES = ("half or double", "x .3 to 3", "tenth", "opposite", "half a bonus")
"""Kinds that believe other values than the hypotheses and their variants."""
OTHERWISE = ("unwritten", "scrambled", "tire", "misread", "misread clips")
"""Kinds that believe a fact incorrectly that no hypothesis contains, kinds with unsuitable
hypotheses, and kinds that answer otherwise."""
KINDS = (AS_ASSUMED, *BY_A_VARIANT, *OTHER_VALUES, *OTHERWISE)
IN_WORDS = {
    "half": "half the values",
    "double": "double the values",
    "half or double": "each half or double",
    "x .3 to 3": "each × .3 to 3",
    "tenth": "a tenth of the values",
    "opposite": "the opposite error",
    "half a bonus": "obstacles half a bonus",
    "unwritten": "a fact in no hypothesis",
    "scrambled": "hypotheses of something else",
}
"""Names of kinds in pictures."""
SIZES = {"half": (0.5,), "double": (2.0,), "tenth": (0.1,), "half or double": (0.5, 2.0)}
"""Factors on incorrect numbers; one factor is drawn independently for each number."""
MISREAD, CLIP = 0.15, 4
"""Share of misread questions; number of transitions in a clip."""


@cache
def setting_of(domain: Domain, people: str, seed: int) -> Setting:
    """Draws two to five types at random; ``people`` decides how their values differ."""
    rng = stream(seed, "benchmark", "types")
    types = RandomCover(2 + seed % 4).types(domain, rng)
    if people not in (*BY_A_VARIANT, *OTHER_VALUES):
        return Setting.build(domain, types)
    own = []
    for one in types:
        wanted = {fact.name: believed(domain, fact, people, rng) for fact in domain.parameters}
        own.append(UserType(one.name, {name: wanted[name] for name in one.inaccurate}))
    return Setting.build(domain, tuple(own))


def believed(domain: Domain, fact: Parameter, people: str, rng: np.random.Generator) -> Any:
    """Returns the value that a person of this kind believes: the assumed value if it is no number,
    or if the domain refuses the drawn value.

    The opposite of a wrong value w is 2a − w, on the other side of the robot's value a: people who
    would believe a bonus to be a penalty believe it to be a larger bonus, and an obstacle becomes a
    bonus. The distance from a is halved until the domain accepts the value (a discount is below 1).
    """
    wrong, right = fact.inaccurate, fact.accurate
    if isinstance(wrong, bool) or not isinstance(wrong, (int, float)):
        return wrong
    if people == "opposite":
        tried = [right + (right - wrong) / 2**k for k in range(8)]
    elif people == "half a bonus":  # obstacles have the robot's value 0; all else is as assumed
        tried = [right - wrong / 2 if right == 0 else wrong]
    elif people == "x .3 to 3":
        tried = [wrong * float(np.exp(rng.uniform(np.log(0.3), np.log(3))))]
    else:
        tried = [wrong * float(rng.choice(SIZES[people]))]
    accurate = {parameter.name: parameter.accurate for parameter in domain.parameters}
    for value in tried:
        try:
            domain.model(accurate | {fact.name: value})
        except XplainError:
            continue
        return value
    return wrong


def without_a_fact(domain: Domain, seed: int, folder: Path) -> str:
    """Writes a file of hypotheses without one of the facts."""
    full = hypotheses_of(domain, None)
    fact = int(stream(seed, "benchmark", "unwritten").integers(full.n_messages))
    rows = np.flatnonzero(full.facts >> fact & 1 == 0)
    path = folder / "hypotheses.npz"
    Hypotheses.of(
        full.labels[rows],
        full.facts[rows],
        full.messages,
        features=full.features,
        feature_names=full.feature_names,
        states=full.states,
        variants=full.variants[:, rows] if len(full.variants) else full.variants,
    ).save(path)
    return str(path)


def scrambled(domain: Domain, seed: int, folder: Path) -> str:
    """Writes a file of useless hypotheses: each transition has the labels of another transition."""
    full = hypotheses_of(domain, None)
    moved = stream(seed, "benchmark", "scrambled").permutation(full.n_transitions)
    path = folder / "hypotheses.npz"
    replace(full, labels=full.labels[:, moved], variants=full.variants[:, :, moved]).save(path)
    return str(path)


@dataclass(frozen=True)
class Altered:
    """A query design with observers whose answers are altered."""

    queries: Queries
    alter: Callable[[Answer], Answer]

    def ask(self, setting: Setting, sizes: Any, answer: Answer, seed: int) -> Any:
        """Asks as the query design does, and alters the answers."""
        return self.queries.ask(setting, sizes, self.alter(answer), seed)


def tired(answer: Answer, points: int, seed: int) -> Answer:
    """Adds errors that rise from 2 to 15 % over an observer's labels."""
    asked: dict[int, int] = {}

    def worse(observer: int, transitions: Any, told: Any) -> NDArray[np.uint8]:
        before = asked.get(observer, 0)
        asked[observer] = before + len(told)
        rate = 0.02 + 0.13 * (before + np.arange(len(told))) / max(points - 1, 1)
        flip = stream(seed, "tire", observer, before).random(len(told)) < rate
        return answer(observer, transitions, told) ^ flip.astype(np.uint8)

    return worse


def misreading(answer: Answer, setting: Setting, seed: int) -> Answer:
    """Misreads a share of the questions: one message is overlooked, or the label is for a possible
    next step (at the end of a trace, for another step to the same state)."""
    rng = stream(seed, "misread")
    reachable = setting.reachable

    def neighbour(transition: NDArray[np.int64]) -> NDArray[np.int64]:
        beside = reachable[reachable[:, 0] == transition[2]]
        if not len(beside):
            beside = reachable[reachable[:, 2] == transition[2]]
        chosen: NDArray[np.int64] = rng.choice(beside)
        return chosen

    def misread(observer: int, transitions: Any, told: Any) -> NDArray[np.uint8]:
        if rng.random() >= MISREAD:
            return answer(observer, transitions, told)
        messages = indices(int(told[0]))
        if messages and rng.random() < 0.5:
            return answer(observer, transitions, told & ~(1 << int(rng.choice(messages))))
        return answer(observer, np.array([neighbour(one) for one in transitions]), told)

    return misread


def differing(domain: Domain, people: str, seed: int) -> tuple[float, float]:
    """Returns two shares of the labels of all types, transitions and message sets: the share that
    differs from the hypotheses' labels at the assumed values, and the share that differs from the
    variant nearest to each type."""
    setting, hypotheses = setting_of(domain, people, seed), hypotheses_of(domain, None)
    labels = setting.label_table(setting.reachable)  # [N, T, 2^n]
    told = np.arange(labels.shape[2])
    shares = []
    for own, table in zip(setting.bits, labels, strict=True):
        held = sum(1 << j for j in own) & ~told
        said = hypotheses.tables[:, hypotheses.row(held)]  # [1 + V, 2^n, T]
        shares.append((said != table.T).mean(axis=(1, 2)))
    assumed = [share[0] for share in shares]
    return float(np.mean(assumed)), float(np.mean([share.min() for share in shares]))
