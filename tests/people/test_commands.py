"""The commands of a study and a collection: each error is one line, and what pages and comments
name is taken; a replay is equal to the last bit, and notices every change."""

import re
import shutil
import sqlite3
from collections import Counter, defaultdict
from contextlib import closing
from pathlib import Path
from typing import get_args

import pytest
import yaml

from tests.conftest import Run
from tests.people.collect.test_prepare import TABLE
from tests.people.street import KINDS, filled, flow_of
from tests.people.visitors import arrive
from xplain.cli.people import load_config, server_of
from xplain.errors import XplainError
from xplain.experiment.config import CONF, compose_config
from xplain.people.export import find_differences
from xplain.people.log import read
from xplain.people.plan import LabQuestion, make_typed
from xplain.people.store import Store
from xplain.people.study.flow import ENDS
from xplain.people.web import TAB_KINDS

DOCS = Path(__file__).parents[2] / "docs"
SETTING = re.compile(r"`([a-z][\w.]*=[^`]+)`")
OF_FILES = ("hydra.searchpath", "types", "key")
"""Settings that need a file, or are no key."""


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("study", ["port=0"], "port=0: a whole number"),
        ("study", ["port=65536"], "port=65536: a whole number"),
        ("study", ["port=many"], "port='many'"),
        ("study", ["prot=1"], "did you mean port?"),
        ("study", ["8080"], "key=value"),
        ("study", ["server.entry=[anybody]"], "server.entry.0='anybody'"),
        ("study", ["database=broken.sqlite"], "not a study's database"),
        ("study", ["rules.per_cell=0"], "rules.per_cell=0"),
        ("study", ["trace.candidates=0"], "trace.candidates=0"),
        ("study export", ["nothing.sqlite", "out"], "nothing.sqlite"),
        ("study replay", ["nothing.sqlite"], "nothing.sqlite"),
        ("study backup", ["broken.sqlite", "copy.sqlite"], "broken.sqlite.key beside it"),
        ("study replay", ["broken.sqlite"], "not a study's database"),
        ("study analyse", ["nowhere"], "participants.csv"),
        ("study bots", ["--key", "k", "--url", "http://127.0.0.1:9"], "a running study"),
        ("study bots", ["--key", "k", "--url", "lab.example.org/"], "a running study"),
        ("collect", ["queries=independent"], "battery or adaptive"),
        ("collect", ["queries=adaptive", "queries.in_turn=true"], "queries.in_turn=True"),
        ("collect", ["briefing=some"], "briefing='some'"),
        ("collect", ["rules.people=1"], "rules.people=1"),
        ("collect", ["points=3"], "rules.repeats=2"),
        ("collect", ["transitions=nowhere.csv"], "nowhere.csv"),
        ("collect", ["facts=f.csv"], "only with transitions"),
        ("collect", ["transitions=own.csv", "briefing=assigned"], "they name no types"),
        ("collect", ["database=broken.sqlite"], "not a study's database"),
        ("collect", ["server.key=secret"], "server.key"),
    ],
)
def test_what_is_wrong_is_one_line(
    tmp_path: Path, run: Run, command: str, arguments: list[str], said: str
) -> None:
    (tmp_path / "broken.sqlite").write_text("broken " * 500)
    (tmp_path / "own.csv").write_text(TABLE.replace("cable.png", ""))
    code, _, error = run(command, *arguments)
    assert code == 2
    (line,) = [line for line in error.splitlines() if "preparing" not in line]
    assert said in line
    assert not [*(tmp_path / "outputs").rglob("*.sqlite")]


def settings() -> list[tuple[str, list[str]]]:
    """Lists every ``key=value`` in the text of a page, in groups without two values of one key;
    placeholders are filled in."""
    found = defaultdict[tuple[str, int], list[str]](list)
    for kind in ("study", "collect"):
        text, met = (DOCS / f"{kind}.md").read_text(encoding="utf-8"), Counter[str]()
        for span in dict.fromkeys(SETTING.findall(re.sub(r"```.*?```", "", text, flags=re.S))):
            if span.split("=")[0] not in OF_FILES and not span.startswith(f"{kind} "):
                key = re.split("[.=]", span)[0]
                found[kind, met[key]] += re.split(r" (?=[\w.@/]+=)", span.replace("…", "XYZ"))
                met[key] += 1
    return [(kind, words) for (kind, _), words in found.items()]


@pytest.mark.parametrize(("kind", "words"), settings())
def test_settings_that_a_page_names_are_taken(kind: str, words: list[str]) -> None:
    load_config(kind, words)


def test_every_ending_can_have_a_code_of_its_own(kind: str) -> None:
    own = {ending: f"OF{number}" for number, ending in enumerate((*ENDS, "full"))}
    given = ", ".join(f"{ending}: {code}" for ending, code in own.items())
    assert server_of(load_config(kind, [f"server.codes={{{given}}}"])).codes == own
    found = server_of(load_config(kind, ["server.codes={full: ABC}"]))
    assert found.codes == dict.fromkeys(own, "") | {"full": "ABC"}


COMMENTED = ("study.yaml", "collect/texts/en.yaml")
EXAMPLES = [
    (file, found)
    for file in COMMENTED
    for found in re.findall(r"^#\s+- (\{name: .*\})$", (CONF / file).read_text("utf-8"), re.M)
]


@pytest.mark.parametrize(("file", "example"), EXAMPLES)
def test_commented_questions_can_be_asked(file: str, example: str) -> None:
    question = make_typed(LabQuestion, "questions", yaml.safe_load(example))
    assert question.label[0].isupper()


LATE = "WHERE kind = 'labels' AND number = (SELECT max(number) FROM event WHERE kind = 'labels')"
EVERYWHERE = {
    "an answer left out": "DELETE FROM event WHERE number = (SELECT min(number) FROM event "
    "WHERE kind = 'labels')",
    "events left out": "DELETE FROM event WHERE kind = 'read'",
    "a label": "UPDATE event SET payload = replace(payload, '\"labels\": [1', '\"labels\": [0')",
    "a state": "UPDATE event SET state = replace(state, '\"part\": 1', '\"part\": 0')",
    "where somebody is": f"UPDATE event SET state = json_set(state, '$.stage', 'done') {LATE}",
    "an answer put in": (
        "INSERT INTO event SELECT participant, 999, source, 999, kind, wall, monotonic, boot, "
        "browser, payload, state, (SELECT max(number) + 1 FROM event) FROM event "
        "WHERE kind = 'labels' LIMIT 1"
    ),
}
OF_A_STUDY = {
    "a belief": f"UPDATE event SET state = json_set(state, '$.belief[0]', 0.25) {LATE}",
    "what was given": f"UPDATE event SET state = json_set(state, '$.given', 77) {LATE}",
    "a decision": f"UPDATE event SET state = json_set(state, '$.new', 77) {LATE}",
    "why": f"UPDATE event SET state = json_set(state, '$.values', json('{{}}')) {LATE}",
    "a score": "UPDATE event SET state = json_set(state, '$.score', 3) WHERE kind = 'quiz'",
}
OF_A_COLLECTION = {
    "a belief": f"UPDATE event SET state = json_set(state, '$.belief.none', 0.25) {LATE}",
    "what a clip is for": "UPDATE event SET state = replace(state, 'question', 'repeat')",
    "what others believe incorrectly": "UPDATE event SET payload = json_set(payload, '$.others', "
    "json('{}')) WHERE kind = 'consent' AND json_extract(payload, '$.after') <> '[]'",
    "a number": "UPDATE event SET payload = json_set(payload, '$.number', 77) "
    "WHERE kind = 'consent'",
}
CHANGES = {"study": EVERYWHERE | OF_A_STUDY, "collect": EVERYWHERE | OF_A_COLLECTION}


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def answered(kind: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Makes a database in which three people answered, in a folder; returns also their ids."""
    folder = tmp_path_factory.mktemp("answered")
    return folder, filled(kind, folder / "s.sqlite")


@pytest.fixture
def snapshot(answered: tuple[Path, list[str]], tmp_path: Path) -> Path:
    """Makes a separate copy of the database."""
    return Path(shutil.copytree(answered[0], tmp_path, dirs_exist_ok=True)) / "s.sqlite"


def changed(snapshot: Path, *statements: str) -> None:
    """Changes the database, which nobody may do, without its triggers."""
    with closing(sqlite3.connect(snapshot)) as connection, connection:
        for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'"):
            connection.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            assert connection.execute(statement).rowcount > 0, statement


def differs(kind: str, snapshot: Path) -> list[str]:
    flow = flow_of(kind)
    return find_differences(flow, read(snapshot, flow.PLAN, flow.STATE)[1])


def test_a_replay_notices_every_change(kind: str, snapshot: Path, tmp_path: Path) -> None:
    assert differs(kind, snapshot) == []
    for what, statement in CHANGES[kind].items():
        path = Path(shutil.copy(snapshot, tmp_path / what))
        changed(path, statement)
        assert differs(kind, path), what


def test_code_that_decides_otherwise_does_not_go_on_with_what_was_begun(
    kind: str, snapshot: Path, run: Run
) -> None:
    Store(snapshot, flow_of(kind)).close()
    changed(snapshot, "UPDATE event SET state = json_set(state, '$.part', 7) WHERE kind = 'labels'")
    with pytest.raises(XplainError, match="continue and replay with that version"):
        Store(snapshot, flow_of(kind))
    code, out, listed = run(f"{kind} replay", snapshot)
    assert (code, f"{len(listed.splitlines())} differences\n" in out) == (1, True)


def test_of_whoever_was_erased_others_are_replayed(
    kind: str, snapshot: Path, answered: tuple[Path, list[str]], run: Run
) -> None:
    """People whose questions depended on the erased answers are replayed, too."""
    with closing(Store(snapshot)) as database:
        reference = database.reference(answered[1][0])
    assert run(f"{kind} erase", snapshot, reference)[1].startswith(f"erased {reference}; ")
    assert run(f"{kind} replay", snapshot)[1] == "2 participants replayed: all equal\n"
    if kind == "collect":
        _, people = read(snapshot, flow_of(kind).PLAN, flow_of(kind).STATE)
        assert any(1 in one.first("consent")["after"] for one in people)


def test_what_a_page_reports_is_told_in_the_consent_and_exported(
    kind: str, tmp_path: Path, run: Run
) -> None:
    path = tmp_path / "s.sqlite"
    with closing(Store(path, flow_of(kind))) as store:
        visitor, page = arrive(store)
        kinds = [*get_args(TAB_KINDS)]
        items = [
            {"n": n, "kind": one, "ms": 1.0, "at": 1.0, "what": f"seen {one}"}
            for n, one in enumerate(kinds)
        ]
        report = {"token": page.hidden["token"], "tab": "a" * 16, "items": items}
        assert visitor.client.post("/events", json=report).status_code == 200
    run(f"{kind} export", path, "out")
    exported = (tmp_path / "out" / "events.csv").read_text()
    assert [one for one in kinds if f"seen {one}" not in exported] == []
    shipped = " ".join(compose_config(kind, []).wording.consent)
    for stored in ("click", "hides it", "look up", "recruiting platform", "reference", "erase"):
        assert stored in shipped, stored
