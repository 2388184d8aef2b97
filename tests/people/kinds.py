"""Both kinds of flow, for tests of common properties: a flow on the street, and its people."""

from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.people.collect import stand_in as collecting
from tests.people.study import stand_in as studying
from tests.people.visitors import take_part
from xplain.people.bots import Bot
from xplain.people.collect.bot import Observer
from xplain.people.flow import Flow
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study

KINDS = ("study", "collect")
ASKING = "asking"
"""A study all of whose people are asked, where pages are meant."""


@cache
def flow_of(kind: str) -> Flow[Any, Any]:
    """Makes one flow for all tests; no result depends on its cache."""
    if kind == "study":
        return studying.street_study()
    if kind == ASKING:
        own = {"asking": studying.CONFIG["conditions"]["personalized"]}
        return studying.street_study(ask=studying.ASK, conditions=own)
    return collecting.street_collection(listening=2)


def bot_of(flow: Flow[Any, Any], *seeds: int) -> Bot[Any, Any]:
    """Makes a participant who never errs."""
    rng = np.random.default_rng(seeds)
    if isinstance(flow, Study):
        return StudyBot(flow.plan, studying.FAULTLESS, rng)
    roles = flow.plan.roles
    return Observer(flow.plan, roles[seeds[-1] % len(roles)].held, collecting.FAULTLESS, rng)


def filled(kind: str, path: Path, people: int = 3) -> list[str]:
    """Makes a database in which this number of people reached the end; returns their ids in order
    of arrival."""
    with closing(Store(path, flow_of(kind))) as store:
        ends = take_part(store, (bot_of(store.flow, number) for number in range(people)))
        assert {*ends} == {"done"}
        return [*store.people]
