"""What a labeler of hypotheses looks at on a trace is all that its answers depend on."""

from __future__ import annotations

import numpy as np
import pytest

from tests.domains.configs import setting_of
from xplain.data.observers import SimulatedObservers
from xplain.data.queries import Independent
from xplain.domains.base import transition_features
from xplain.explanation.by_type import ByType
from xplain.questions.labeler import HypothesisTrainer


@pytest.mark.parametrize("transitions_known", [False, True])
def test_the_table_over_what_matters_is_the_whole_table(transitions_known: bool) -> None:
    setting = setting_of("domain=rescue")
    dataset, _ = SimulatedObservers(1, 40).collect(setting, Independent(), 0)
    labeler = HypothesisTrainer(domain=setting.domain).fit(dataset.of(np.array([0])), 0)
    transitions = setting.reachable[::9]
    features = transition_features(setting.domain, transitions)
    if transitions_known:
        relevant, table = labeler.relevant_table_of(features, transitions)  # type: ignore[attr-defined]
        whole = labeler.table_of(features, 6, transitions)  # type: ignore[attr-defined]
    else:
        relevant, table = labeler.relevant_table(features)
        whole = labeler.table(features, 6)
    by_type = ByType(relevant[None], table[None])
    assert by_type.over(range(6))[0] == pytest.approx(whole, abs=1e-9)
