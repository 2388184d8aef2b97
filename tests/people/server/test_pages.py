"""The way through the pages of a study and of a collection, one page at a time."""

import base64
import gc
import re
from dataclasses import replace

import numpy as np
import pytest
from markupsafe import escape

from tests.people.street import (
    ASKING,
    KINDS,
    SCREENS,
    bot_of,
    collection_plan,
    flow_of,
    street_collection,
    street_plan,
    telling,
)
from tests.people.visitors import (
    Opened,
    Visitor,
    arrive,
    differences,
    enter,
    newcomer,
    pages,
    query,
    take_part,
    way,
)
from xplain.people.bots import Page
from xplain.people.collect.asking import (
    ATTENTION,
    REPEAT,
    AskedClip,
    CollectState,
    mean_posterior,
)
from xplain.people.collect.flow import Collection
from xplain.people.collect.tables import KnownSoFar, glance
from xplain.people.plan import Picture
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.tables import steps_of
from xplain.questions.questionnaire import Questionnaire

BEFORE = {
    "study": ("consent", *["briefing"] * SCREENS, "practice", "practice", "ahead", "eligibility"),
    "collect": ("consent", "task", "task", "practice", "practice", "ahead"),
}
STEPS = {"study": ["evaluation"] * 4, "collect": ["clips"] * 15 + ["listening"] * 6}
AFTER = {"study": ("quiz", "questions", "done"), "collect": ("beliefs", "questions", "done")}


@pytest.mark.parametrize("kind", KINDS)
def test_reload_back_second_tab_and_double_click_change_nothing(opened: Opened, kind: str) -> None:
    store = opened(flow_of(kind))
    one, (token,) = newcomer(store), store.invite(1, "bot")
    two, old, stages = one.another(), list[list[tuple[str, str]]](), list[str]()
    for html, page in pages(one, bot_of(store.flow, 0), token):
        last, stages = html, [*stages, page.stage]
        again = Page.of_html(one.get("/study")[1])  # reload
        assert (again.stage, again.steps) == (page.stage, page.steps)
        # No inline script or style, nothing from elsewhere, and the mark of simulated people.
        assert not re.search(r"<script(?! src=\"/static)", html), page.stage
        assert not re.search(r"\son\w+=|\sstyle=|<style|javascript:", html), page.stage
        assert not re.search(r"(src|href)=\"(?!/|#)", html), page.stage
        assert "Simulated participant" in html
        assert not re.search(r"conformant|personalized|type [XYZ]", html), page.stage
        enter(two, token)  # another tab, another device
        assert Page.of_html(two.get("/study")[1]).hidden == page.hidden
        for fields in [*old[:2], *old[-4:]]:  # pages before, sent once more
            status, shown = one.post("/study", fields)
            assert status in (200, 409)  # as it was answered, or otherwise
            assert Page.of_html(shown).hidden == page.hidden
        if page.hidden:
            other = [(name, choices[-1][0]) for name, choices in page.fields.items()]
            old.append([*page.hidden.items(), *other])
    assert stages == [*BEFORE[kind], *STEPS[kind], *AFTER[kind]]
    kinds = [e["kind"] for e in query(store, "SELECT kind FROM event WHERE source = 'protocol'")]
    waits = {one.name: one.kind for one in store.flow.STAGES}
    assert kinds == [waits[stage] for stage in stages[:-1]]
    assert store.participant(store.enter_invited(token)).identity["code"] in last
    paragraphs, plan = [*store.flow.plan.texts.debriefing], store.flow.plan
    if kind == "study":  # and what was not true, as it was said and as it is
        role = plan.roles[store.present()[0].state.user_type]
        paragraphs += [t for j in role.wrong for t in (role.briefing[j], plan.facts[j].message)]
    for paragraph in paragraphs:
        assert str(escape(paragraph)).split("&#39;")[0] in last
    assert differences(store) == []


def test_earlier_labels_stay_and_only_the_new_one_is_needed(store: Store, browser: Visitor) -> None:
    for _, page in pages(browser, bot_of(store.flow, 0), *store.invite(1, "person")):
        if page.stage == "evaluation":
            break
    _, html, page = browser.answer(page, ("label_0", "0"))
    assert 'name="label_0" value="0" required checked' in html
    status, html, page = browser.answer(page)
    assert status == 400
    assert "Please say for each step" in html
    assert browser.answer(page, ("label_1", "1"))[0] == 200
    (who,) = store.everybody()
    assert [step.labels for step in steps_of(who)][:2] == [(0,), (0, 1)]


def test_a_message_is_said_again_in_words_that_blame_nobody(opened: Opened) -> None:
    """A repeated message is marked, in its own place: a page never shows a message twice."""
    told = {"_target_": "xplain.explanation.belief.Independent", "accept": 0.8, "forget": 0.1}
    store, marked = opened(Study.of(street_plan(belief=told))), list[str]()
    for number in range(6):
        for html, page in way(store, bot_of(store.flow, number, forgetting=0.9, losing=0.9)):
            assert len(set(page.messages)) == len(page.messages)
            marked += re.findall(r'<span class="tag">Said again:</span> (.*?)</div>', html)
    again = [(s.page.previous or 0) & s.page.new for p in store.everybody() for s in steps_of(p)]
    assert len(marked) == sum(mask.bit_count() for mask in again) > 0


def test_what_people_write_is_escaped_everywhere(store: Store, browser: Visitor) -> None:
    attack = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>{{7*7}}\x00\u202e"
    _, html = browser.get("/?invitation=" + "%3Cscript%3Ealert(1)%3C/script%3E&PROLIFIC_PID=%22%3E")
    assert "<script>alert" not in html
    for html, page in pages(browser, bot_of(store.flow, 0), *store.invite(1, "person")):
        assert "<script>alert" not in html
        if page.stage == "questions":
            own = ("answer_comment", attack)
            status, html, page = browser.answer(page, ("answer_age", attack), own)
            assert status == 400
            assert "<script>alert" not in html
            browser.answer(page, ("answer_age", "30"), own)
            break
    (row,) = query(store, "SELECT payload FROM event WHERE kind = 'answers'")
    assert "<script>" in row["payload"]  # kept as it was written
    assert "<script>alert" not in browser.get("/researcher")[1]
    # The domain's own sentences are text, too.
    assert "<robot>" in store.flow.plan.facts[0].belief


def test_without_a_map_the_page_lists_what_each_step_changed(opened: Opened) -> None:
    """The list ends at the step that is shown."""
    plan = street_plan(map_shown=False)
    told = tuple((f"now past place {k}", f"no longer at <{k}>") for k in range(plan.n_steps))
    shown = tuple(replace(clip, changes=new) for clip, new in zip(plan.shown, told, strict=True))
    plan = StudyPlan.from_text(replace(plan, shown=shown).text)
    store = opened(Study.of(plan))
    listed = [
        re.findall(r"now past place (\d+); no longer at &lt;\d+&gt;</li>", html)
        for html, page in way(store, bot_of(store.flow, 0))
        if page.stage == "evaluation"
    ]
    assert listed == [[str(i) for i in range(k + 1)] for k in range(plan.n_steps)]


def test_an_answer_to_a_page_that_was_not_shown_is_refused(store: Store) -> None:
    visitor, page = arrive(store)
    agreed, client = {**page.hidden, "agree": "1", "ms": "1500.5"}, visitor.client
    assert client.post("/study", data=agreed).status_code == 303  # and is not followed
    unseen = {**page.hidden, "kind": "read", "sequence": "1", "ms": "-1"}
    assert client.post("/study", data=unseen).status_code == 409
    assert Page.of_html(visitor.get("/study")[1]).stage == "briefing"
    assert client.post("/study", data=unseen).status_code == 303
    # No page was open for less than no time.
    assert [
        event.browser
        for event in store.participant(store.present()[0].id).events
        if event.source == "protocol"
    ] == [1500.5, None]


def test_a_question_comes_with_the_messages_moves_no_progress_and_counts_once(
    opened: Opened,
) -> None:
    store, seen = opened(flow_of(ASKING)), 0
    for number, token in enumerate(store.invite(3, "bot")):
        told, part, visitor, before = set[str](), set[str](), newcomer(store), None
        for html, page in pages(visitor, bot_of(store.flow, number), token):
            if before:  # from a second tab, as it was and otherwise, of a question that is over
                statuses = sorted(visitor.answer(before, ("label", one))[0] for one in "01")
                assert statuses == [200, 409]
                before = None
            if page.stage not in ("asking", "evaluation"):
                continue
            (said, _) = re.findall(r"Part \d+ of \d+", html)  # read and heard
            part.add(said)
            if page.stage == "asking":
                assert {*page.messages} == told
                assert "New message" not in html
                assert "<h1>One extra step</h1>" in html
                assert re.findall('name="label" value="(.)" required>', html) == ["1", "0", "2"]
                assert "checked" not in html
                assert visitor.answer(page)[0] == 400
                before, seen = page, seen + 1
            told = {*page.messages}
        assert len(part) == 1
    (counted,) = query(store, "SELECT count(*) AS n FROM event WHERE kind = 'clip'")
    assert counted["n"] == seen >= 3
    assert differences(store) == []


def test_of_the_erased_nothing_stays_in_memory(opened: Opened) -> None:
    store = opened(street_collection(points=8))
    gc.collect()
    earlier = [one for one in gc.get_objects() if isinstance(one, (Questionnaire, KnownSoFar))]
    known = {id(one) for one in earlier}
    take_part(store, [bot_of(store.flow, 0, number) for number in range(2)])
    glance(store.flow, store.present())
    (text, reference), kept = ((one.state.text, store.reference(one.id)) for one in store.present())

    def remembered() -> set[str]:
        gc.collect()
        alive = gc.get_objects()
        states = {one.text for one in alive if isinstance(one, CollectState)}
        new = [one for one in alive if id(one) not in known]
        asked = any(isinstance(one, Questionnaire) and one.asked for one in new)
        return {
            *({"state"} if text in states else ()),
            *({"questionnaire"} if asked else ()),
            *({"types"} if any(isinstance(one, KnownSoFar) for one in new) else ()),
        }

    assert remembered() == {"types"}
    store.erase_by(reference)
    assert remembered() == set()
    assert [(one.state.text, store.reference(one.id)) for one in store.present()] == [kept]


def test_a_clip_shows_just_what_is_told_there(opened: Opened) -> None:
    store, given = opened(telling()), set[int]()
    known = {fact.message: 1 << j for j, fact in enumerate(store.flow.plan.facts)}
    for html, page in way(store, bot_of(store.flow, 0, 1)):
        assert not re.search(f"{ATTENTION}|{REPEAT}|posterior", html)
        if page.stage == "clips":
            (one,) = store.present()
            clip = one.state.clip
            assert sum(known[sentence] for sentence in page.messages) == clip.told
            assert list(page.steps) == list(clip.transitions)
            assert len(page.fields) == clip.size
            phrases = store.flow.plan.hypotheses.phrases
            assert all(f"The robot {phrases[t]}" in html for t in clip.transitions)
            assert "question" not in html.replace("Questions?", "").replace("questions", "")
            given.add(clip.told)
    assert len(given) > 8
    assert differences(store) == []


def test_assigned_briefings_are_balanced_shown_again_and_found(opened: Opened) -> None:
    store = opened(street_collection(briefing="assigned"))
    roles, known = store.flow.plan.roles, store.flow.plan.hypotheses
    for number in range(6):
        for _, page in way(store, bot_of(store.flow, 0, number)):
            if page.stage == "clips":
                assert tuple(page.facts) in [role.briefing for role in roles]
            assert page.stage != "task" or len(page.facts) <= 3
    states = [one.state for one in store.present()]
    assert sorted(state.role for state in states) == [0, 0, 1, 1, 2, 2]
    for state in states:  # each answered as the briefing says, whoever they were before
        held = roles[state.role].held
        assert state.stated == tuple(held >> j & 1 for j in range(len(store.flow.plan.facts)))
        assert state.belief[str(known.essential[known.row(np.array(held))])] > 0.9
    assert differences(store) == []


def test_images_of_own_transitions_are_served(opened: Opened) -> None:
    content, plan = b"\x89PNG picture", collection_plan()
    picture = Picture("image/png", base64.b64encode(content).decode())
    plan = replace(plan, shown=(replace(plan.shown[0], picture=picture), *plan.shown[1:]))
    store = opened(Collection(plan))
    client = arrive(store)[0].client
    reply = client.get("/picture/0")
    assert (reply.status_code, reply.data) == (200, content)
    assert reply.headers["Content-Type"] == "image/png"
    assert reply.headers["X-Content-Type-Options"] == "nosniff"
    for name in ("1", "99", "-1", "x", "..%2f0", "0x0"):
        assert client.get(f"/picture/{name}").status_code == 404
    # The obvious step has a picture, too: it would be the only page without one.
    obvious = CollectState(stage="clips", number=0, clip=AskedClip("attention", (), 0))
    assert store.flow.view(obvious)["illustrated"] == [0]


def test_many_at_once_share_what_was_known_when_they_came(opened: Opened) -> None:
    """People and bots never share."""
    store = opened(street_collection(points=8))
    take_part(store, [bot_of(store.flow, 0, 4)], "bot")
    ways = [way(store, bot_of(store.flow, 0, number)) for number in range(3)]
    for _ in range(40):  # a page each in turn
        for one in ways:
            next(one, None)
    take_part(store, [bot_of(store.flow, 0, 5)])
    take_part(store, [bot_of(store.flow, 0, 6)], "bot")
    after = [event.payload.get("after") for event in store.events("kind = 'consent'")]
    assert after == [[], [], [], [], [2, 3, 4], [1]]
    first, *people, last, _ = (one.state for one in store.present())
    assert [one.others for one in (first, *people)] == [{}] * 4
    assert last.others == mean_posterior([one.belief for one in people]) != {}
    assert differences(store) == []
