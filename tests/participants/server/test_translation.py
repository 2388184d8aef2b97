"""Every word of the pages comes from files: in a made-up language nothing of English is left."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.collect import stand_in as collect_stand_in
from tests.collect.stand_in import wording
from tests.participants.visitors import GENEROUS, Visitor, enter, pages
from tests.study.stand_in import CONFIG, FAULTLESS, english_words, street_plan
from xplain.collect.protocol.plan import Collection
from xplain.collect.server.protocol import CollectProtocol
from xplain.collect.simulation.observer import observer
from xplain.errors import InputError
from xplain.participants.server.app import create_app
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import Page
from xplain.study.policies import study_of
from xplain.study.server.protocol import StudyProtocol
from xplain.study.simulation.participant import Person

PLACES = ("bridge", "market", "school", "tunnel")


def made_up(text: str) -> str:
    """Every word with Q before it, what is filled in as it is."""
    return re.sub(r"\{\w+\}|[^\W\d_]+", lambda m: m[0] if m[0][0] == "{" else f"Q{m[0]}", text)


def translated(value: Any) -> Any:
    if isinstance(value, str):
        return made_up(value)
    if isinstance(value, dict):
        return {key: translated(item) for key, item in value.items()}
    return [translated(item) for item in value] if isinstance(value, list) else value


class Words(HTMLParser):
    """Every word that somebody may see or hear."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.feed(html)

    def handle_data(self, data: str) -> None:
        self.found |= set(re.findall(r"[^\W\d_]+", data))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("alt", "aria-label", "title", "placeholder", "data-lost"):
                self.handle_data(value or "")


SENTENCES = {
    place: {"message": f"The {place} is fine", "belief": f"The {place} is bad"} for place in PLACES
}
PHRASES = {word: made_up(word) for word in ("goes", "straight", "around", "at", "the", *PLACES)}


@pytest.fixture
def foreign(tmp_path: Path) -> Iterator[Store]:
    texts = CONFIG["wording"]
    keep = {"words", "rewards", "icons", "hide", "phrases", "facts"}
    own = {key: translated(value) for key, value in texts.items() if key not in keep}
    choice = {"kind": "choice", "choices": ["one", "two"], "required": True}
    plan = street_plan(
        wording=texts
        | own
        | {
            "words": translated(english_words()) | {"language": "q"},
            "facts": translated(SENTENCES),
            "rewards": translated(texts["rewards"]),
            "icons": {},
            "phrases": PHRASES,
        },
        before=[{"name": "a", "label": made_up("first"), **translated(choice), "kind": "choice"}],
        questions=[
            {"name": "b", "label": made_up("scale"), "kind": "scale", "low": 1, "high": 5}
            | {"ends": [made_up("no"), made_up("yes")]}
        ],
    )
    store = Store(tmp_path / "s.sqlite", StudyProtocol(study_of(plan)))
    yield store
    store.close()


def left_over(html: str) -> set[str]:
    """Words of no made-up language; letters of the map and its items are none."""
    return {
        word for word in Words(html).found if word[0] != "Q" and not re.fullmatch("[A-Z]", word)
    }


def test_nothing_of_english_is_left_in_another_language(foreign: Store) -> None:
    app = create_app(foreign, GENEROUS)
    person = Person(foreign.protocol.plan, FAULTLESS, np.random.default_rng(0))
    (token,) = foreign.invite(1, "person")
    code = {foreign.participant(foreign.enter_invited(token)).code}
    stages = []
    for html, page in pages(Visitor(app.test_client()), person, token):
        stages.append(page.stage)
        reference = re.findall(r'id="reference">([^<]*)<', html)
        assert left_over(html.replace(reference[0], "") if reference else html) <= code, page.stage
        assert '<html lang="q">' in html
    assert {"before", "evaluation", "quiz", "questions", "done"} <= set(stages)


def test_what_cannot_be_done_is_said_in_that_language_too(foreign: Store) -> None:
    app = create_app(foreign, GENEROUS)
    visitor = Visitor(app.test_client())
    assert left_over(visitor.get("/")[1]) == set()
    assert left_over(visitor.get("/nowhere")[1]) == set()
    assert left_over(visitor.get("/study")[1]) == set()
    (token,) = foreign.invite(1, "person")
    html = enter(visitor, token)
    for fields in ([("agree", "7")], [("agree", "1"), ("text", "another")], [("kind", "read")]):
        hidden = {**Page(html).hidden, **dict(fields)}
        status, answer = visitor.post("/study", list(hidden.items()))
        assert status == 400
        assert left_over(answer) == set(), fields


def test_every_end_debriefs_gives_a_reference_and_a_code_of_its_own(
    foreign: Store, person: Callable[..., Person]
) -> None:
    """However a part ends; and in the other language, again."""
    app = create_app(foreign, GENEROUS)
    codes = set()
    for ending in ("declined", "screened_out", "ineligible", "withdrawn", "timed_out", "done"):
        (token,) = foreign.invite(1, "bot")
        who = foreign.enter_invited(token)
        state = f"""'{{"stage": "{ending}"}}'"""
        with foreign.transaction() as do:
            do(
                f"UPDATE participant SET over = 1, state = json_patch(state, {state}) WHERE id = ?",
                (who,),
            )
        visitor = Visitor(app.test_client())
        enter(visitor, token)
        html = visitor.get("/study")[1]
        for paragraph in foreign.protocol.plan.texts.debriefing:
            assert paragraph in html, ending
        reference = "-".join(re.findall("....", who))
        assert reference in html, ending
        (code,) = re.findall(r'id="code">([A-Z]{8})<', html)
        codes.add(code)
        assert left_over(html.replace(reference, "").replace(code, "")) == set(), ending
        assert 'href="/consent.txt"' in html
    assert len(codes) == 6
    copy = app.test_client().get("/consent.txt").text
    assert all(paragraph in copy for paragraph in foreign.protocol.plan.texts.consent)
    assert foreign.protocol.plan.texts.consent_hash in copy


def test_a_language_without_all_its_words_is_refused() -> None:
    words = english_words()
    del words["quiz_hint"]
    with pytest.raises(InputError, match=r"wording\.words\.quiz_hint"):
        street_plan(wording=CONFIG["wording"] | {"words": words})


@pytest.fixture(params=["none", "assigned"])
def collecting(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Store]:
    """A collection of labels in the same language."""
    english = wording(questions=[])
    keep = {"words", "icons", "hide", "phrases", "facts", "questions"}
    own = {key: value if key in keep else translated(value) for key, value in english.items()}
    plan = collect_stand_in.street_plan(
        briefing=request.param,
        words=own
        | {
            "words": translated(english["words"]) | {"language": "q"},
            "facts": translated(SENTENCES),
            "phrases": PHRASES,
            "questions": [
                {"name": "a", "label": made_up("number"), "kind": "number", "low": 1, "high": 9},
                {"name": "b", "label": made_up("which"), "kind": "choice"}
                | {"choices": [made_up("one"), made_up("two")]},
            ],
        },
    )
    store = Store(tmp_path / "c.sqlite", CollectProtocol(Collection(plan)))
    yield store
    store.close()


def test_nothing_of_english_is_left_on_the_pages_of_a_collection(collecting: Store) -> None:
    visitor = Visitor(create_app(collecting, GENEROUS).test_client())
    person = observer(collecting.protocol.plan, collect_stand_in.FAULTLESS, 0, 0)
    (token,) = collecting.invite(1, "bot")
    code = {collecting.participant(collecting.enter_invited(token)).code}
    assert left_over(visitor.get("/")[1]) == set()
    assert left_over(visitor.get("/nowhere")[1]) == set()
    stages = set()
    html = enter(visitor, token)
    while True:
        page = Page(html)
        stages.add(page.stage)
        reference = re.findall(r'id="reference">([^<]*)<', html)
        assert left_over(html.replace(reference[0], "") if reference else html) <= code, page.stage
        assert '<html lang="q">' in html
        if not page.hidden:
            break
        # What cannot be done is said first, then it is done.
        for fields in ({"kind": "quiz"}, {"a": "x", "stated": "7", "text": "another"}):
            status, answer = visitor.post("/study", list({**page.hidden, **fields}.items()))
            if status == 400:
                assert left_over(answer) == set(), page.stage
        html = visitor.post("/study", [*page.hidden.items(), *person.fill(page)[0]])[1]
    assert stages == {*collecting.protocol.stages}


@pytest.mark.parametrize("ending", ["declined", "withdrawn", "timed_out"])
def test_every_end_of_a_collection_debriefs_in_its_language(collecting: Store, ending: str) -> None:
    (token,) = collecting.invite(1, "bot")
    who = collecting.enter_invited(token)
    state = f"""'{{"stage": "{ending}", "left": "task", "number": 1}}'"""
    with collecting.transaction() as do:
        do(
            f"UPDATE participant SET over = 1, state = json_patch(state, {state}) WHERE id = ?",
            (who,),
        )
    visitor = Visitor(create_app(collecting, GENEROUS).test_client())
    enter(visitor, token)
    html = visitor.get("/study")[1]
    for paragraph in collecting.protocol.plan.texts.debriefing:
        assert paragraph in html
    (code,) = re.findall(r'id="code">([A-Z]{8})<', html)
    reference = "-".join(re.findall("....", who))
    assert left_over(html.replace(reference, "").replace(code, "")) == set()
    if ending == "timed_out":  # whoever was away goes on where they were
        page = Page(html)
        assert Page(visitor.post("/study", list(page.hidden.items()))[1]).stage == "task"


def test_a_collection_without_all_its_words_is_refused() -> None:
    words = wording()["words"]
    del words["sense"]
    with pytest.raises(InputError, match=r"wording\.words\.sense"):
        collect_stand_in.street_plan(words=wording(words=words))
