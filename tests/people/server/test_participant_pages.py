"""The participants' pages, one after the other."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.people.client import Client
from tests.people.study.stand_in import FAULTLESS, street_plan
from tests.people.visitors import GENEROUS, Visitor, consent, enter, field, pages, query
from xplain.errors import InputError
from xplain.people.bots import Page
from xplain.people.plan import make_typed
from xplain.people.server import Server
from xplain.people.site import Site
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.tables import steps_of
from xplain.people.web import create_app


def test_earlier_labels_stay_and_only_the_new_one_is_needed(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], StudyBot]
) -> None:
    visitor = browser()
    for _, page in pages(visitor, person(), store.invite(1, "person")[0]):
        if page.stage == "evaluation":
            break
    hidden = dict(page.hidden)
    _, html = visitor.post("/study", [*hidden.items(), ("label_0", "0")])
    hidden = Page.of_html(html).hidden
    assert 'name="label_0" value="0" required checked' in html
    status, html = visitor.post("/study", [*hidden.items()])
    assert status == 400
    assert "Please say for each step" in html
    status, html = visitor.post("/study", [*hidden.items(), ("label_1", "1")])
    assert status == 200
    (who,) = store.everybody()
    assert [step.labels for step in steps_of(who)][:2] == [(0,), (0, 1)]


def test_a_message_is_said_again_in_words_that_blame_nobody(tmp_path: Path) -> None:
    """A repeated message is marked, and moves to its new position: a page never shows a message
    twice."""
    belief = {"_target_": "xplain.explanation.belief.Independent", "accept": 0.8, "forget": 0.1}
    store = Store(tmp_path / "s.sqlite", Study.of(street_plan(belief=belief)))
    client = create_app(store, GENEROUS)
    habits, marked = replace(FAULTLESS, forgetting=0.5, losing=0.5), []
    for number, token in enumerate(store.invite(18, "bot")):
        someone = StudyBot(store.flow.plan, habits, np.random.default_rng(number))
        for html, page in pages(Visitor(Client(client)), someone, token):
            assert len(set(page.messages)) == len(page.messages)
            marked += re.findall(r'<span class="tag">Said again:</span> (.*?)</div>', html)
    people = store.everybody()
    again = [(s.page.previous or 0) & s.page.new for one in people for s in steps_of(one)]
    assert len(marked) == sum(mask.bit_count() for mask in again) > 0
    store.close()


def test_pages_have_no_inline_script_or_style_and_load_nothing_from_elsewhere(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], StudyBot]
) -> None:
    for html, page in pages(browser(), person(), store.invite(1, "bot")[0]):
        assert not re.search(r"<script(?! src=\"/static)", html), page.stage
        assert not re.search(r"\son\w+=|\sstyle=|<style|javascript:", html), page.stage
        assert not re.search(r"(src|href)=\"(?!/|#)", html), page.stage
        assert "Simulated participant" in html  # bots are marked on every page too
        assert not re.search(r"conformant|personalized|type [XYZ]", html), page.stage


def test_what_people_write_is_escaped_everywhere(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], StudyBot]
) -> None:
    attack = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>{{7*7}}\x00\u202e"
    visitor = browser()
    _, html = visitor.get("/?invitation=" + "%3Cscript%3Ealert(1)%3C/script%3E&PROLIFIC_PID=%22%3E")
    assert "<script>alert" not in html
    for html, page in pages(visitor, person(), store.invite(1, "person")[0]):
        assert "<script>alert" not in html
        if page.stage == "questions":
            fields = [*page.hidden.items(), ("answer_age", attack), ("answer_comment", attack)]
            status, html = visitor.post("/study", fields)
            assert status == 400
            assert "<script>alert" not in html
            fields[-2] = ("answer_age", "30")
            visitor.post("/study", fields)
            break
    (row,) = query(store, "SELECT payload FROM event WHERE kind = 'answers'")
    assert "<script>" in row["payload"]  # kept as it was written
    _, html = visitor.get("/researcher")
    assert "<script>alert" not in html
    # The domain's own sentences are text, too.
    plan = street_plan()
    assert "<robot>" in plan.facts[0].belief


def test_entry_is_as_configured(store: Store) -> None:
    closed = Client(create_app(store, Server(entry=("platform",), studies=("s",))))
    html = closed.get("/").text
    visitor = field(html, "token")
    assert 'name="invitation"' not in html
    assert "<button>Begin" not in html  # a link without ids lets nobody in
    (token,) = store.invite(1, "person")
    for data in ({"invitation": token}, {}, {"invitation": ""}):
        assert closed.post("/enter", data=data | {"token": visitor}).status_code == 403
    ids = {"id_PROLIFIC_PID": "p", "id_STUDY_ID": "s", "id_SESSION_ID": "x"}
    assert closed.post("/enter", data=ids).status_code == 403  # without the form's token
    assert closed.post("/enter", data=ids | {"token": visitor}).status_code == 303
    for wrong in ({"id_PROLIFIC_PID": "p" * 101}, {"id_PROLIFIC_PID": ""}, {"id_SESSION_ID": ""}):
        assert closed.post("/enter", data=ids | wrong | {"token": visitor}).status_code == 403
    with pytest.raises(InputError, match=r"server\.entry"):
        make_typed(Server, "server", {"entry": ["anybody"]})


def test_without_a_map_the_page_lists_what_each_step_changed(
    tmp_path: Path, person: Callable[[], StudyBot]
) -> None:
    """Up to the step that is shown, and no further."""
    plan = street_plan(map_shown=False)
    told = tuple((f"now past place {k}", f"no longer at <{k}>") for k in range(plan.n_steps))
    shown = tuple(replace(clip, changes=new) for clip, new in zip(plan.shown, told, strict=True))
    plan = StudyPlan.from_text(replace(plan, shown=shown).text)
    assert plan.changes == told
    opened = Store(tmp_path / "listed.sqlite", Study.of(plan))
    (token,) = opened.invite(1, "person")
    visitor = Visitor(Client(create_app(opened, GENEROUS)))
    shown = [
        re.findall(r"now past place (\d+); no longer at &lt;\d+&gt;</li>", html)
        for html, page in pages(visitor, person(), token)
        if page.stage == "evaluation"
    ]
    assert shown == [[str(i) for i in range(k + 1)] for k in range(plan.n_steps)]
    opened.close()


def test_a_list_of_ids_lets_nobody_else_in(store: Store, tmp_path: Path) -> None:
    """The platform sends an id in the address; the file is read at every arrival."""
    file = tmp_path / "ids.txt"
    file.write_text("ann\nbert\n")
    server = Server(entry=("platform",), id_names=("survey_code",), ids=str(file))
    client = Client(create_app(store, server))
    page = client.get("/?survey_code=ann").text
    assert field(page, "id_survey_code") == "ann"
    token = field(page, "token")

    def comes(who: str) -> int:
        data = {"id_survey_code": who, "token": token}
        return client.post("/enter", data=data).status_code

    assert [comes(who) for who in ("ann", "made up", "", "ann", "carl")] == [
        303,
        403,
        403,
        303,
        403,
    ]
    file.write_text("ann\nbert\ncarl\n")
    assert comes("carl") == 303
    assert len(store.people) == 2
    with pytest.raises(ValueError, match=r"server\.ids"):
        replace(server, ids=str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match=r"server\.studies"):
        replace(server, studies=("s",))
    with pytest.raises(ValueError, match=r"server\.id_names"):
        replace(server, id_names=())


def test_the_platform_gets_its_id_back(store: Store) -> None:
    back = "https://example.org/credit?who={id}&code={code}"
    with pytest.raises(ValueError, match=r"server\.completion_url"):
        Server(completion_url=back)
    server = replace(GENEROUS, keep_ids=True, completion_url=back, completion_code="C0DE")
    own = Site(store, server)
    ids = {"PROLIFIC_PID": "a&b", "STUDY_ID": "s", "SESSION_ID": "x"}
    found = store.participant(store.enter_from_platform(ids, keep=True))
    assert own.back(found, "C0DE") == "https://example.org/credit?who=a%26b&code=C0DE"


def test_who_finds_no_place_gets_the_code_for_it(store: Store) -> None:
    places = len(store.flow.plan.cells) * store.flow.plan.rules.per_cell
    for token in store.invite(places, "person"):
        consent(store, store.enter_invited(token))
    for codes, code in (({}, ""), ({"full": "FULL1"}, "FULL1")):
        visitor = Visitor(Client(create_app(store, replace(GENEROUS, codes=codes))))
        page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
        status, html = visitor.post("/study", [*page.hidden.items(), ("agree", "1")])
        assert status == 503
        assert "There is no free place" in html
        assert ("FULL1" in html) == bool(code)
