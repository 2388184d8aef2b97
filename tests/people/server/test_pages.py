"""The pages of a study and of a collection, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI

from tests.people.client import Client
from tests.people.kinds import KINDS, bot_of, flow_of
from tests.people.study.stand_in import SCREENS
from tests.people.visitors import GENEROUS, Visitor, differences, enter, pages, query
from xplain.people.bots import Page
from xplain.people.store import Store
from xplain.people.web import create_app

BEFORE = {
    "study": ("consent", *["briefing"] * SCREENS, "training", "training", "ahead", "eligibility"),
    "collect": ("consent", "task", "task", "practice", "practice", "ahead"),
}
STEPS = {"study": ["evaluation"] * 4, "collect": ["clips"] * 15 + ["listening"] * 6}
AFTER = {"study": ("quiz", "questions", "done"), "collect": ("beliefs", "questions", "done")}


@pytest.fixture(params=KINDS)
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """A store of one of the flows."""
    opened = Store(tmp_path / f"{request.param}.sqlite", flow_of(request.param))
    yield opened
    opened.close()


@pytest.fixture
def app(store: Store) -> FastAPI:
    return create_app(store, GENEROUS)


def test_the_way_from_entrance_to_code(store: Store, app: FastAPI) -> None:
    kind, (token,) = store.path.stem, store.invite(1, "person")
    seen = list(pages(Visitor(Client(app)), bot_of(store.flow, 0), token))
    stages = [page.stage for _, page in seen]
    assert stages == [*BEFORE[kind], *STEPS[kind], *AFTER[kind]]
    last = seen[-1][0]
    assert store.participant(store.enter_invited(token)).identity["code"] in last
    for paragraph in store.flow.plan.texts.debriefing:
        assert paragraph.split("'")[0] in last  # debriefed
    assert differences(store) == []


def test_reload_back_second_tab_and_double_click_change_nothing(store: Store, app: FastAPI) -> None:
    (token,) = store.invite(1, "person")
    one, two, old = Visitor(Client(app)), Visitor(Client(app)), []
    stages = []
    for _, page in pages(one, bot_of(store.flow, 0), token):
        stages.append(page.stage)
        again = Page.of_html(one.get("/study")[1])  # reload
        assert (again.stage, again.steps) == (page.stage, page.steps)
        enter(two, token)  # another tab, another device
        assert Page.of_html(two.get("/study")[1]).hidden == page.hidden
        for fields in old:  # every page before, sent once more
            status, html = one.post("/study", fields)
            assert status in (200, 409)  # as it was answered, or otherwise
            assert Page.of_html(html).hidden == page.hidden
        if page.hidden:
            other = [(name, choices[-1][0]) for name, choices in page.fields.items()]
            old.append([*page.hidden.items(), *other])
    kinds = [e["kind"] for e in query(store, "SELECT kind FROM event WHERE source = 'protocol'")]
    waits = {one.name: one.kind for one in store.flow.STAGES}
    assert kinds == [waits[stage] for stage in stages[:-1]]
    assert differences(store) == []
