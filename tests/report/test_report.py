"""Reports from a sweep whose numbers are known: tables, differences, curves, page."""

import base64
import html
import itertools
import json
import re
import shlex
import shutil
from dataclasses import replace

import pytest

from tests.refusals import line_of
from tests.report import handmade
from xplain.experiment.results import load_results, save_results
from xplain.report.compare import table
from xplain.report.frame import Summary
from xplain.report.page import write_report
from xplain.report.terminal import print_summary
from xplain.runs.job import mark_failed

METHODS = ("qmdp", "qhr", "baseline")
SETTINGS = ({"domain": "rescue"}, {"domain": "four_rooms", "users.count": "2"})


def test_a_domain_is_called_by_the_name_that_its_configuration_gives(tmp_path, capsys, no_pictures):
    """An example is ``domain=pddl domain.name=coffee``; without a name, the chosen file names
    it."""
    chosen = [{"domain": "pddl", "seed": "0"}, {"domain": "pddl", "seed": "1"}, {"domain": "rover"}]
    folder = handmade.sweep(tmp_path, chosen, lambda values, trace: 1.0 + trace)
    for name, given in (("domain=pddl,seed=0", "coffee"), ("domain=rover", None)):
        own = folder / "results" / name
        results = load_results(own)
        config = {**results.config, "domain": {"name": given}, "traces": 4}
        save_results(own, replace(results, config=config))
        print_summary(load_results(own))
    (folder / "results" / "domain=pddl,seed=1" / "results.json").unlink()
    summary = Summary(folder)
    assert summary.values("domain") == ["coffee", "rover"]
    write_report(folder)
    assert "<h3>coffee</h3>" in (folder / "report" / "index.html").read_text("utf-8")
    assert (folder / "report" / "trace_coffee.svg").exists()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" · ")[0] for line in lines if " · " in line] == ["coffee", "rover"]


@pytest.fixture
def sweep(tmp_path):
    """Makes a sweep that the test may change."""
    return made(tmp_path)


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """Makes a sweep that all tests read, with its report."""
    folder = made(tmp_path_factory.mktemp("sweep"))
    write_report(folder)
    return folder


def made(tmp_path):
    jobs = [
        setting | {"solver": method, "lambda": trade_off, "seed": seed}
        for setting, method, trade_off, seed in itertools.product(
            SETTINGS, METHODS, ("0.5", "1"), "012"
        )
    ]

    def regret(values, trace):
        base = {"qmdp": 0.5, "qhr": 2.0, "baseline": 12.0}[values["solver"]]
        return base * float(values["lambda"]) + 0.3 * ((7 * int(values["seed"]) + 3 * trace) % 5)

    return handmade.sweep(tmp_path, jobs, regret, report="table1", pool=["users.count"])


def test_missing_jobs_are_told(sweep, no_pictures):
    lost = "domain=rescue,solver=qmdp,lambda=1,seed=2"
    (sweep / "results" / lost / "results.json").unlink()
    (sweep / "jobs" / lost).mkdir(parents=True)
    failure = {"error": "InputError: <no>", "traceback": ""}
    (sweep / "jobs" / lost / "failure.json").write_text(json.dumps(failure))
    summary = Summary(sweep)
    assert "1 of 36 jobs are missing" in table(summary).caption
    _, report = write_report(sweep)
    page = (report / "index.html").read_text()
    assert "InputError: &lt;no&gt;" in page


def test_the_page_is_whole_and_loads_nothing(known):
    report = known / "report"
    text = (report / "index.html").read_text()
    for tag in {*re.findall(r"<([a-z]\w*)", text)} - {"meta", "img", "link", "br"}:
        assert len(re.findall(rf"<{tag}[\s>]", text)) == text.count(f"</{tag}>")
    loads = re.findall(r"<[^>]* (?:src|href)=\"([^\"]*)", text)
    assert all(address.startswith("data:") for address in loads)
    assert not re.search(r"url\(|@import|<script[^>]* src|\bfetch\(|XMLHttpRequest|import\(", text)
    for domain in (setting["domain"] for setting in SETTINGS):
        said = f"The robot of {domain} likes <fire>."
        assert text.count(html.escape(said)) == 1
    for name in ("regret", "messages", "inexplicable", "belief"):
        drawing = base64.b64encode((report / f"{name}.svg").read_bytes()).decode()
        assert drawing in text


@pytest.mark.parametrize(("trade_offs", "middle"), [("12", "1"), (("0.5", "2", "3"), "2")])
def test_the_page_says_who_costs_least_and_how_to_see_an_explanation(
    tmp_path, no_pictures, trade_offs, middle
):
    jobs = [
        {"solver": solver, "lambda": trade_off, "seed": seed}
        for solver, trade_off, seed in itertools.product(("qmdp", "qhr"), trade_offs, "012")
    ]
    handmade.sweep(
        tmp_path, jobs, lambda v, _: 1.0 + (v["solver"] == "qhr") + 0.01 * int(v["seed"])
    )
    _, report = write_report(tmp_path)
    text = (report / "index.html").read_text()
    said = "Least cost: QMDP in {0} of {0} problems ({0} decided)".format(len(trade_offs))
    assert f'<p class="answer">{said}' in text
    assert "<figcaption>Regret against λ</figcaption>" in text
    (command,) = re.findall(r"<code>(python -m xplain demo .*?)</code>", text)
    words = shlex.split(html.unescape(command))
    assert {"solver=qmdp", f"lambda={middle}"} < set(words)
    assert words[-4:] == ["--trace", "0", "--user", "A"]


def test_the_report_is_the_same_bytes_each_time(known):
    report = known / "report"
    before = {path.name: path.read_bytes() for path in report.iterdir()}
    shutil.rmtree(report)
    write_report(known)
    assert {path.name: path.read_bytes() for path in report.iterdir()} == before


def test_a_report_is_made_again_when_what_it_shows_has_changed(tmp_path, monkeypatch, no_pictures):
    folder = handmade.sweep(tmp_path, [{"solver": own} for own in METHODS], lambda *_: 1.0)

    def is_made(measure=None):
        (_, report), marked = write_report(folder, measure), tmp_path / "report" / "table.md"
        made = marked.read_text() != "mine"
        assert (report / "index.html").exists()
        marked.write_text("mine")
        return made

    assert is_made()
    assert not is_made()
    (tmp_path / "report" / "regret.csv").unlink()
    assert is_made()
    address = folder / "results" / "solver=qhr"
    save_results(address, replace(load_results(address), seconds={"explain": 5.0}))
    assert is_made()
    assert is_made("cost")
    (address / "results.json").unlink()
    assert is_made("cost")
    mark_failed(folder / "jobs" / "solver=qhr", MemoryError())
    assert is_made("cost")
    monkeypatch.setattr("xplain.report.page.code_version", lambda: "other sources")
    assert is_made("cost")
    assert not is_made("cost")


def test_only_a_reproduction_of_table_1_says_it_is_one(tmp_path, known, no_pictures):
    handmade.sweep(tmp_path, [{"solver": own} for own in METHODS], lambda values, trace: 1.0)
    write_report(tmp_path)
    for folder, is_one in ((tmp_path, False), (known, True)):
        page = (folder / "report" / "index.html").read_text()
        assert ("Reproduction of Table 1" in page) == is_one
        assert (folder / "report" / "claims.md").exists() == is_one
        assert ("beside the paper’s" in page) == is_one
    write_report(known, "cost")  # the paper has no values of this measure
    assert "beside the paper’s" not in (known / "report" / "index.html").read_text()
    write_report(known)


def test_the_command_finds_the_newest_sweep_and_names_what_is_wrong(sweep, run, no_pictures):
    for measure in ("regret", "cost"):
        lines = run("report", sweep, f"measure={measure}")[1].splitlines()
        files = sorted(str(path) for path in (sweep / "report").iterdir())
        assert lines[0].startswith(f"{measure.capitalize()}: ")
        assert lines[-len(files) :] == files
    for arguments in ([], [sweep / "jobs"], ["--help-me"]):
        line_of(run("report", *arguments))
