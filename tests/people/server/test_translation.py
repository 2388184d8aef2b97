"""Every word of the pages comes from files: in an invented language no English remains."""

import re
from dataclasses import replace
from typing import Any

import pytest
from markupsafe import Markup

from tests.people.street import (
    ASK,
    CONFIG,
    PLACES,
    bot_of,
    collection_plan,
    english_words,
    street_plan,
    street_study,
    wording,
)
from tests.people.visitors import Opened, enter, newcomer
from xplain.errors import InputError
from xplain.people.bots import Page
from xplain.people.collect.flow import Collection
from xplain.people.store import Store


def made_up(text: str) -> str:
    """Puts Q before every word, except for words in braces."""
    return re.sub(r"\{\w+\}|[^\W\d_]+", lambda m: m[0] if m[0][0] == "{" else f"Q{m[0]}", text)


def translated(value: Any) -> Any:
    if isinstance(value, str):
        return made_up(value)
    if isinstance(value, dict):
        return {key: translated(item) for key, item in value.items()}
    return [translated(item) for item in value] if isinstance(value, list) else value


READ = re.compile('(?:alt|aria-label|title|placeholder|data-lost)="([^"]*)"')


def words_of(html: str) -> set[str]:
    """Returns every word that people may see or that a screen reader may read."""
    found = Markup(" ").join([Markup(html).striptags(), *map(Markup, READ.findall(html))])
    return set(re.findall(r"[^\W\d_]+", found.unescape()))


SENTENCES = {
    place: {"message": f"The {place} is fine", "belief": f"The {place} is bad"} for place in PLACES
}
PHRASES = {word: made_up(word) for word in ("goes", "straight", "around", "at", "the", *PLACES)}


LANGUAGE = {"icons": {}, "facts": translated(SENTENCES), "phrases": PHRASES}
KEPT = {"words", "rewards", "icons", "phrases", "facts", "questions"}
QUESTIONS = [
    {"name": "a", "label": made_up("number"), "kind": "number", "low": 1, "high": 9},
    {"name": "b", "label": made_up("which"), "kind": "choice", "required": True}
    | {"choices": [made_up("one"), made_up("two")]},
    {"name": "c", "label": made_up("scale"), "kind": "scale", "low": 1, "high": 5}
    | {"ends": [made_up("no"), made_up("yes")]},
]


def in_the_language(english: dict[str, Any]) -> dict[str, Any]:
    """Returns texts of a study or a collection, with every word translated."""
    own = {key: value if key in KEPT else translated(value) for key, value in english.items()}
    words = translated(english["words"]) | {"language": "q"}
    return own | LANGUAGE | {"words": words, "questions": QUESTIONS}


@pytest.fixture(params=["study", "asking", "none", "assigned"])
def foreign(opened: Opened, request: pytest.FixtureRequest) -> Store:
    """Stores a study, a study with a condition that asks, or a collection without or with a
    briefing, in the made-up language."""
    if request.param in ("none", "assigned"):
        words = in_the_language(wording())
        return opened(Collection(collection_plan(briefing=request.param, words=words)))
    texts = in_the_language(CONFIG["wording"])
    texts["rewards"] = translated(texts["rewards"])
    number, which, scale = texts.pop("questions")  # a study's are beside its texts
    own = {"asking": CONFIG["conditions"]["personalized"]}
    more = {"ask": ASK, "conditions": own} if request.param == "asking" else {}
    lab = {"before": [which], "questions": [number, scale]}
    return opened(street_study(wording=texts, **lab, **more))


def left_over(html: str) -> set[str]:
    """Lists words that are not in the made-up language; letters of the map and its items do not
    count."""
    return {word for word in words_of(html) if word[0] != "Q" and not re.fullmatch("[A-Z]", word)}


def test_nothing_of_english_is_left_in_another_language(foreign: Store) -> None:
    visitor = newcomer(foreign)
    person, (token,) = bot_of(foreign.flow, 0), foreign.invite(1, "bot")
    code = {foreign.participant(foreign.enter_invited(token)).identity["code"]}
    for path in ("/", "/nowhere", "/study"):
        assert left_over(visitor.get(path)[1]) == set()
    stages, html = set(), enter(visitor, token)
    while True:
        page = Page.of_html(html)
        stages.add(page.stage)
        reference = re.findall(r'id="reference" translate="no">([^<]*)<', html)
        assert left_over(html.replace(reference[0], "") if reference else html) <= code, page.stage
        assert '<html lang="q" dir="ltr">' in html
        if not page.hidden:
            break
        # What cannot be done is said first, then it is done.
        for fields in ({"kind": "x"}, {"a": "x", "text": "another"}):
            status, answer = visitor.post("/study", list({**page.hidden, **fields}.items()))
            if status == 400:
                assert left_over(answer) == set(), page.stage
        html = visitor.post("/study", [*page.hidden.items(), *person.fill(page)[0]])[1]
    assert {foreign.flow.part(one) for one in stages} == {*foreign.flow.stages}
    assert ("asking" in stages) == ("asking" in getattr(foreign.flow.plan, "conditions", ()))


def test_every_end_debriefs_gives_a_reference_and_a_code_of_its_own(foreign: Store) -> None:
    """This holds for every end, and in the invented language."""
    texts, codes = foreign.flow.plan.texts, set()
    first = foreign.flow.stages[1]
    for ending in (*foreign.flow.STATE.ENDS, "done"):
        (token,) = foreign.invite(1, "bot")
        who = foreign.enter_invited(token)
        at = replace(foreign.flow.STATE(), stage=ending, left=first)
        with foreign.changes():
            foreign.append(who, "server", "moved", {}, state=at.text)
        visitor = newcomer(foreign)
        enter(visitor, token)
        html = visitor.get("/study")[1]
        away = ending == "timed_out"
        assert all(paragraph in html for paragraph in texts.debriefing) != away, ending
        reference = "-".join(re.findall("....", foreign.reference(who)))
        assert reference in html, ending
        own = re.findall(r'id="code" translate="no">([A-Z]{8})<', html)
        assert len(own) == (not away), ending
        codes.update(own)
        assert left_over(html.replace(reference, "").replace("".join(own), "")) == set(), ending
        assert 'href="/consent.txt"' in html
        if (ending, first) == ("timed_out", "task"):  # whoever was away goes on where they were
            with foreign.changes():
                here = replace(foreign.participant(who).state, number=1)
                foreign.append(who, "server", "moved", {}, state=here.text)
            page = Page.of_html(html)
            again = visitor.post("/study", list(page.hidden.items()))[1]
            assert Page.of_html(again).stage == "task"
    assert len(codes) == len(foreign.flow.STATE.ENDS)
    _, copy = visitor.get("/consent.txt")
    assert all(paragraph in copy for paragraph in texts.consent)
    assert texts.consent_hash in copy


def test_a_language_without_all_its_words_is_refused() -> None:
    words = english_words()
    del words["quiz_hint"]
    with pytest.raises(InputError, match=r"wording\.words\.quiz_hint"):
        street_plan(wording=CONFIG["wording"] | {"words": words})
    words = wording()["words"]
    del words["sense"]
    with pytest.raises(InputError, match=r"wording\.words\.sense"):
        collection_plan(words=wording(words=words))
