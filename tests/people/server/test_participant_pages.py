"""The way through the participants' pages, one page at a time."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.people.study.stand_in import FAULTLESS, street_plan
from tests.people.visitors import GENEROUS, Visitor, consent, enter, field, logged, pages
from xplain.errors import InputError
from xplain.people.bots import Page, visit
from xplain.people.http import Context, Server
from xplain.people.map_svg import picture
from xplain.people.plan import typed
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
    (who,) = logged(store)
    assert [step["labels"] for step in steps_of(who)][:2] == ["[0]", "[0, 1]"]


def test_a_message_is_said_again_in_words_that_blame_nobody(tmp_path: Path) -> None:
    """Marked as said before, in its own place: a page never says a message twice."""
    belief = {"_target_": "xplain.explanation.belief.Independent", "accept": 0.8, "forget": 0.1}
    store = Store(tmp_path / "s.sqlite", Study.of(street_plan(belief=belief)))
    client = create_app(store, GENEROUS)
    habits, marked = replace(FAULTLESS, forgetting=0.5, losing=0.5), []
    for number, token in enumerate(store.invite(18, "bot")):
        someone = StudyBot(store.flow.plan, habits, np.random.default_rng(number))
        for html, page in pages(Visitor(client.test_client()), someone, token):
            assert len(set(page.messages)) == len(page.messages)
            marked += re.findall(r'<span class="tag">Said again:</span> (.*?)</div>', html)
    people = logged(store)
    again = [step["given"] & step["messages"] for one in people for step in steps_of(one)]
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
            fields = [*page.hidden.items(), ("age", attack), ("comment", attack)]
            status, html = visitor.post("/study", fields)
            assert status == 400
            assert "<script>alert" not in html
            visitor.post("/study", [*page.hidden.items(), ("age", "30"), ("comment", attack)])
            break
    (row,) = store.query("SELECT payload FROM event WHERE kind = 'answers'")
    assert "<script>" in row["payload"]  # kept as it was written
    _, html = visitor.get("/researcher")
    assert "<script>alert" not in html
    # The domain's own sentences are text, too.
    plan = street_plan()
    assert "<robot>" in plan.facts[0].belief


def test_entry_is_as_configured(store: Store) -> None:
    closed = create_app(store, Server(entry=("platform",), studies=("s",))).test_client()
    html = closed.get("/").text
    visitor = field(html, "token")
    assert 'name="invitation"' not in html
    assert "<button>Begin" not in html  # a link without ids lets nobody in
    (token,) = store.invite(1, "person")
    for data in ({"invitation": token}, {}, {"invitation": ""}):
        assert closed.post("/enter", data=data | {"token": visitor}).status_code == 403
    ids = {"PROLIFIC_PID": "p", "STUDY_ID": "s", "SESSION_ID": "x"}
    assert closed.post("/enter", data=ids).status_code == 403  # without the form's token
    assert closed.post("/enter", data=ids | {"token": visitor}).status_code == 303
    for wrong in ({"PROLIFIC_PID": "p" * 101}, {"PROLIFIC_PID": ""}, {"SESSION_ID": ""}):
        assert closed.post("/enter", data=ids | wrong | {"token": visitor}).status_code == 403
    with pytest.raises(InputError, match=r"server\.entry"):
        typed(Server, "server", {"entry": ["anybody"]})


def test_the_platform_gets_its_code_back(store: Store, person: Callable[[], StudyBot]) -> None:
    server = Server(
        completion_url="https://example.org/back?cc={code}",
        completion_code="C0DE",
        burst=1e9,
        visitor_burst=1e9,
    )
    visitor = Visitor(create_app(store, server).test_client())
    *_, (html, _) = pages(visitor, person(), store.invite(1, "person")[0])
    assert 'href="https://example.org/back?cc=C0DE"' in html


def test_a_domain_without_a_map_gets_its_study(tmp_path: Path) -> None:
    from xplain.people.study.flow import Study

    study = Study.of(street_plan(map_shown=False, questions=[]))
    store = Store(tmp_path / "s.sqlite", study)
    visitor = Visitor(create_app(store, GENEROUS).test_client())
    person = StudyBot(study.plan, FAULTLESS, np.random.default_rng(0))
    assert visit(visitor, person, store.invite(1, "bot")[0]) == "done"
    store.close()


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
    visitor = Visitor(create_app(opened, GENEROUS).test_client())
    shown = [
        re.findall(r"now past place (\d+); no longer at &lt;\d+&gt;</li>", html)
        for html, page in pages(visitor, person(), token)
        if page.stage == "evaluation"
    ]
    assert shown == [[str(i) for i in range(k + 1)] for k in range(plan.n_steps)]
    opened.close()


def test_nobody_is_a_person_by_making_up_ids(store: Store) -> None:
    """By default invitations alone let people in; a platform's, only of the configured study."""
    ids = {"PROLIFIC_PID": "p", "STUDY_ID": "made up", "SESSION_ID": "x"}
    for server in (Server(), Server(entry=("platform",), studies=("ours",))):
        client = create_app(store, server).test_client()
        token = field(client.get("/").text, "token")
        assert client.post("/enter", data=ids | {"token": token}).status_code == 403
    ours = ids | {"STUDY_ID": "ours", "token": token}
    assert client.post("/enter", data=ours).status_code == 303
    with pytest.raises(ValueError, match=r"server\.studies"):
        Server(entry=("platform",))


def test_a_list_of_ids_lets_nobody_else_in(store: Store, tmp_path: Path) -> None:
    """Any platform that tells an id in its address; the file is read when somebody comes."""
    file = tmp_path / "ids.txt"
    file.write_text("ann\nbert\n")
    server = Server(entry=("platform",), id_names=("survey_code",), ids=str(file))
    client = create_app(store, server).test_client()
    page = client.get("/?survey_code=ann").text
    assert field(page, "survey_code") == "ann"
    token = field(page, "token")

    def comes(who: str) -> int:
        data = {"survey_code": who, "token": token}
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
    assert len(store.query("SELECT * FROM participant")) == 2
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
    own = Context(store, server)
    ids = {"PROLIFIC_PID": "a&b", "STUDY_ID": "s", "SESSION_ID": "x"}
    found = store.participant(store.enter_from_platform(ids, keep=True))
    assert own.back(found, "C0DE") == "https://example.org/credit?who=a%26b&code=C0DE"


def test_who_finds_no_place_gets_the_code_for_it(store: Store) -> None:
    places = len(store.flow.plan.cells) * store.flow.plan.rules.per_cell
    for token in store.invite(places, "person"):
        consent(store, store.enter_invited(token))
    for codes, code in (({}, ""), ({"full": "FULL1"}, "FULL1")):
        visitor = Visitor(create_app(store, replace(GENEROUS, codes=codes)).test_client())
        page = Page.of_html(enter(visitor, store.invite(1, "person")[0]))
        status, html = visitor.post("/study", [*page.hidden.items(), ("agree", "1")])
        assert status == 503
        assert "There is no free place" in html
        assert ("FULL1" in html) == bool(code)


def test_taken_things_leave_the_map_and_places_have_names() -> None:
    plan = street_plan()
    gone = ("bridge", "market", "school", "tunnel")
    taken = [picture(plan, plan.path, plan.n_steps, gone[:n]) for n in range(5)]
    assert [len(re.findall('font-size="22"|M3 12L12 4L21 12', svg)) for svg in taken] == [
        4,
        3,
        2,
        1,
        0,
    ]
    rulers = re.findall(r"<text[^>]*>([^<]+)</text>", picture(plan, plan.path, 0))
    assert set("ABCDE12") <= set(rulers)


def test_numbers_on_the_map_do_not_reach_into_the_next_cell() -> None:
    plan = street_plan()
    there_and_back = tuple(((0, k % 2), (0, (k + 1) % 2)) for k in range(40))
    svg = picture(plan, there_and_back, 40)
    widths = [float(w) for w in re.findall(r'<rect x="1" y="1" width="([\d.]+)"', svg)]
    assert len(widths) == 2
    assert max(widths) < 64 - 2  # the width of a cell
    assert "40<" in svg  # the newest is always shown
