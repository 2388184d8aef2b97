"""Hypotheses against labels alone while people are asked (:mod:`xplain.learning.evidence`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from xplain.learning.data.dataset import Dataset
from xplain.learning.evidence import BEATEN, parts
from xplain.learning.fact_sets.labels_alone import TwoWays
from xplain.questions.questionnaire import Questionnaire


@dataclass
class Contest:
    """Of those asked so far, one after the other: who is thought to hold the same facts wrong as
    somebody before is foretold by their answers too.

    Attributes:
        ways: hypotheses, and labels alone.
        answers: of everybody asked so far.
        best: what each is thought to hold wrong, as a bitmask.
        ahead: log P of all answers by labels alone, less that by hypotheses.
    """

    ways: TwoWays
    answers: Dataset
    best: list[int] = field(default_factory=list)
    ahead: float = 0.0

    def beaten(self, asked: Questionnaire) -> bool:
        """Whether hypotheses are, once somebody more has answered."""
        person, first = len(self.best), len(self.answers)
        self.best.append(asked.best)
        known = replace(self.answers, observers=(*self.answers.observers, str(person)))
        self.answers = known.answered(person, *asked.answers)
        alike = np.isin(self.answers.observer, np.flatnonzero(np.equal(self.best, asked.best)))
        part = np.where(np.arange(len(self.answers)) < first, -1, parts(self.answers.observer))
        for number in np.unique(part[first:]).tolist():
            before, rows = np.flatnonzero(alike & (part < number)), np.flatnonzero(part == number)
            if len(before):
                train, test = self.answers.take(before), self.answers.take(rows)
                self.ahead += float(self.ways.labels(train, test).sum())
                self.ahead -= float(self.ways.hypotheses(train, test).sum())
        return self.ahead > BEATEN
