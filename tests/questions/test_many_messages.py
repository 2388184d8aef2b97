"""On a trace, the answers of a labeler with hypotheses depend only on the messages of its table."""

import numpy as np
import pytest

from tests.domains.configs import setting_of
from xplain.domains.base import transition_features
from xplain.learning.data.observers import SimulatedObservers
from xplain.learning.data.queries import Independent
from xplain.learning.mixture.labeler import HypothesisTrainer


@pytest.mark.parametrize("transitions_known", [False, True])
def test_the_table_over_what_matters_is_the_whole_table(
    transitions_known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    setting = setting_of("domain=rescue")
    observed = SimulatedObservers(1, 40).collect(setting, Independent(), 0)
    labeler = HypothesisTrainer().adapt_to(observed).fit(observed.dataset.of(np.array([0])), 0)
    transitions = setting.reachable[::9]
    features = transition_features(setting.domain, transitions)
    known = transitions if transitions_known else None
    whole = labeler.table(features, known)
    assert whole.rows == [list(range(6))] * whole.n_types
    for module in ("xplain.learning.labelers", "xplain.learning.mixture.labeler"):
        monkeypatch.setattr(f"{module}.DENSE", 0)
    some = labeler.table(features, known)
    assert some.array(6) == pytest.approx(whole.array(6), abs=1e-9)
