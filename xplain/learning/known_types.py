"""Which user types there are, and what agents know of each: learned from labels, or given.

Observed ── find_types ── KnownTypes (tables of any trace)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.setting import Setting
from xplain.domains.users.types import user_type
from xplain.errors import DomainError, InputError, XplainError
from xplain.explanation.label_table import DENSE
from xplain.learning.data.observers import Observed
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.prediction import fresh_accuracy
from xplain.learning.types import KnownTypes, TraceTables, unless_too_large
from xplain.learning.user_types import AskedOnce, Perfect, TypeFinder, UserTypes, learn_types


@dataclass(frozen=True)
class References:
    """Labelers that policies are compared with.

    Attributes:
        everyone: one labeler of all data (the baseline's).
        perfect: types under perfect clustering, L_pc; None where the true types of the observers
            are unknown.
        oracle: [M] the labeler of each true type under perfect clustering; None where no observer
            behaves like a type, or the true types are unknown.
    """

    everyone: Labeler
    perfect: UserTypes | None = None
    oracle: tuple[Labeler, ...] | None = None


def find_types(
    observed: Observed, trainer: LabelerTrainer, finder: TypeFinder, seed: int
) -> KnownTypes:
    """What agents know of the users: what the trainer knows, else what the labels tell, which are
    the types that the finder finds, with a labeler each.

    Args:
        observed: with its setting.
        trainer: fits the labelers that types are compared with, or knows the types.
        finder: finds the types.
        seed: of the run.

    Raises:
        InputError: the labels are too few, or the types are unknown that the trainer should know.
    """
    if (given := trainer.types_of(observed)) is not None:
        return given
    trainer = trainer.given(observed)  # once: what it works out of its task is kept with it
    everyone = trainer.fit(observed.dataset, seed)
    _require_tested([everyone])  # before the types: too few labels are refused at once
    types = finder.find(observed, seed)
    references = learn_references(observed, trainer, seed, everyone, types.by_observers)
    _require_tested(types.labelers)
    oracle, everything = references.oracle, trainer.everything()
    once = AskedOnce()

    def tables(features: NDArray[np.float64], transitions: NDArray[np.int64]) -> TraceTables:
        return TraceTables(
            learned=once.label_table(types.labelers, features, transitions),
            everyone=unless_too_large(
                lambda: once.label_table([references.everyone], features, transitions)
            ),
            perfect=None if oracle is None else once.label_table(oracle, features, transitions),
            everything=None if everything is None else everything.table(features, transitions),
        )

    clustering, wrong = types.clustering, [labeler.wrong for labeler in types.labelers]
    known = [own for own in wrong if own is not None]
    curve = np.zeros(0) if clustering.curve is None else clustering.curve
    return KnownTypes(
        names=types.names,
        matched_true_type=_match_true_types(observed, types),
        shares=clustering.shares,
        figures=_figures(observed, types, references, trainer, seed),
        curve=np.asarray(curve, dtype=float),
        rule=clustering.rule,
        tables=tables,
        habits=None if types.answers is None else types.answers.habits,
        wrong=np.stack(known) if len(known) == len(wrong) else None,
        new=clustering.new,
    )


def learn_references(
    observed: Observed,
    trainer: LabelerTrainer,
    seed: int,
    everyone: Labeler,
    known: Mapping[tuple[int, ...], Labeler],
) -> References:
    """The labeler of all data (``everyone``), and the labelers under perfect clustering; ``known``
    as of :func:`~xplain.learning.user_types.learn_types`.

    Raises:
        XplainError: too few labels to hold some out.
    """
    dataset = observed.dataset
    if observed.behaviour is None:
        return References(everyone)
    perfect = learn_types(dataset, Perfect().cluster(observed, 0), trainer, seed, known)
    return References(everyone, perfect, _of_each_type(perfect, observed))


def _of_each_type(perfect: UserTypes, observed: Observed) -> tuple[Labeler, ...] | None:
    """The labeler of each true type; None where no observer behaves like it. Clusters are numbered
    as their observers come, which may be in any order."""
    assert observed.setting is not None
    first = [np.flatnonzero(observed.behaviour == alike)[:1] for alike in observed.setting.distinct]
    if not all(map(len, first)):
        return None
    return tuple(perfect.labelers[perfect.clustering.assignment[int(o[0])]] for o in first)


def _match_true_types(observed: Observed, types: UserTypes) -> NDArray[np.int64]:
    """[N] for each learned type the ``distinct`` number of most of its observers; −1 where the
    observers' true types are unknown."""
    matched = np.full(len(types.labelers), -1)
    alike = observed.behaviour
    if alike is not None:
        for learned in range(types.clustering.n_types):
            matched[learned] = np.bincount(alike[types.clustering.members(learned)]).argmax()
    return matched


def _figures(
    observed: Observed,
    types: UserTypes,
    references: References,
    trainer: LabelerTrainer,
    seed: int,
) -> dict[str, float]:
    """How well the types were found and the labels learned, by name.

    ``labeler_accuracy`` is the paper's, on held-out (transition, message set), ``fresh_accuracy``
    what fresh questions would show (:func:`~xplain.learning.prediction.fresh_accuracy`).
    Both are means over types.
    """
    clustering = types.clustering
    fresh = [
        fresh_accuracy(observed.dataset.of(clustering.members(t)), trainer, seed)
        for t in range(clustering.n_types)
    ]
    figures = {
        "types_found": float(len(types.labelers)),
        "labeler_accuracy": _mean_accuracy(types.labelers),
        "fresh_accuracy": float(np.mean(fresh)),
        "everyone_accuracy": references.everyone.accuracy,
    }
    alike = observed.behaviour
    if alike is not None and references.perfect is not None:
        from sklearn.metrics import adjusted_rand_score

        index = adjusted_rand_score(alike, clustering.assignment)
        figures["adjusted_rand_index"] = float(index)
        figures["perfect_labeler_accuracy"] = _mean_accuracy(references.perfect.labelers)
        figures["true_types"] = float(len(np.unique(alike)))
    return figures


def _mean_accuracy(labelers: Iterable[Any]) -> float:
    return float(np.mean([labeler.accuracy for labeler in labelers]))


def _require_tested(labelers: Iterable[Any]) -> None:
    """Raises XplainError where no label could be held out to measure a labeler's confidence."""
    for labeler in labelers:
        if labeler.n_test == 0:
            raise XplainError(
                f"points: too few; the {labeler.n_train} labels of a type are all of one "
                "(transition, message set), and its labeler needs two: one to train it and one "
                "to test it"
            )


def _everything(setting: Setting) -> Setting | None:
    """The setting of one type, who believes every fact incorrectly; None where such a task has no
    way to its goal, or facts are too many."""
    if setting.n_messages > DENSE:
        return None
    names = setting.message_names
    with suppress(DomainError):
        return Setting.build(setting.domain, (user_type(setting.domain, "everything", names),))
    return None


class TrueLabels(LabelerTrainer):
    """Stands where a labeler is chosen, and says that there is none.

    An experiment then plans with the labels of the users' own models, and with one type for each
    true type: what is left to find out is which of them is in front of the robot. A policy's cost
    above the clairvoyant's is what not knowing the type costs; a learned labeler's, above that,
    what its errors cost. True labels belong to the types of a setting, so no cluster of observers
    can have them, and the clusterer is not asked: the observers give the types' shares alone.

    Labels of a user who is one of the types are never impossible, so beliefs need no care, but
    sharpen to certainty: a type that an answer contradicts is ruled out for good.
    """

    def __init__(self) -> None:
        """There is nothing to choose."""
        super().__init__()

    def types_of(self, observed: Observed) -> KnownTypes:
        """The true types with their true labels. One labeler for everybody is the share of
        observers whose type would label so.

        Raises:
            InputError: nobody knows the observers' types, as of real people.
        """
        setting, truth = observed.setting, observed.truth
        everything = _everything(setting) if setting else None
        if setting is None or truth is None:
            raise InputError("labeler", "truth", "needs simulated observers, whose type is known")
        shares = np.bincount(truth, minlength=len(setting.types)) / len(truth)

        def tables(_: NDArray[np.float64], transitions: NDArray[np.int64]) -> TraceTables:
            labels = setting.true_labels(transitions)
            everybody = unless_too_large(lambda: labels.mixed(shares))
            wrong = None if everything is None else everything.true_labels(transitions)
            return TraceTables(labels, everybody, labels, wrong)

        count = float(len(np.unique(setting.distinct)))
        return KnownTypes(
            names=tuple(user_type.name for user_type in setting.types),
            matched_true_type=setting.distinct,
            shares=shares,
            figures={"types_found": count, "true_types": count},
            curve=np.zeros(0),
            rule="truth",
            tables=tables,
            wrong=setting.wrong,
        )

    def fit(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError: whoever fits labelers learns from data alone, without a setting."""
        raise InputError("labeler", "truth", "a labeler that learns; true labels are simulated")

    def fitted(self, *_: Any, **__: Any) -> NoReturn:
        """Raises InputError, as :meth:`fit` does."""
        self.fit()
