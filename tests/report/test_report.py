"""Reports from a sweep whose numbers are known: tables, differences, curves, page."""

from __future__ import annotations

import csv
import html.parser
import io
import itertools
import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy import stats

from tests.report import handmade
from xplain.report import tables
from xplain.report.combinations import differences_csv
from xplain.report.summary import Summary
from xplain.report.write import write_report
from xplain.runs.mlflow_views import MainKey, curves

METHODS = ("qmdp", "qhr", "baseline")
SETTINGS = ({"domain": "rescue"}, {"domain": "four_rooms", "users.count": "2"})
GRID = "#b0b0b0"
SVG = "{http://www.w3.org/2000/svg}"
SEEDS, TRACES, TRADE_OFFS = 3, 4, (0.5, 1.0)


def oracle(trade_off, seed, trace):
    return 2 * trade_off + 0.25 * seed + 0.125 * trace


def regret(method, trade_off, seed, trace):
    base = {"qmdp": 0.5, "qhr": 2.0, "baseline": 12.0}[method]
    return base * trade_off + 0.3 * ((seed * 7 + trace * 3) % 5)


@pytest.fixture
def sweep(tmp_path):
    """A sweep of one's own, to change."""
    return made(tmp_path)


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """A sweep that all read, with its report."""
    folder = made(tmp_path_factory.mktemp("sweep"))
    write_report(folder)
    return folder


def made(tmp_path):
    jobs = [
        setting | {"solver": method, "lambda": f"{trade_off:g}", "seed": str(seed)}
        for setting, method, trade_off, seed in itertools.product(
            SETTINGS, METHODS, TRADE_OFFS, range(SEEDS)
        )
    ]

    def numbers(values):
        return float(values["lambda"]), int(values["seed"])

    return handmade.sweep(
        tmp_path,
        jobs,
        lambda values, trace: regret(values["solver"], *numbers(values), trace),
        lambda values, trace: oracle(*numbers(values), trace),
        TRACES,
        report="table1",
        pool=["users.count"],
    )


def test_the_table_holds_means_intervals_and_the_papers_values(known):
    rows = list(csv.DictReader(io.StringIO(tables.as_csv(Summary(known)))))
    found = {(r["domain"], r["setting"], float(r["lambda"]), r["column"]): r for r in rows}
    assert len(rows) == len(SETTINGS) * len(TRADE_OFFS) * (1 + len(METHODS))
    for method, trade_off in itertools.product(METHODS, TRADE_OFFS):
        row = found["rescue", "all", trade_off, method]
        by_seed = [
            np.mean([regret(method, trade_off, seed, trace) for trace in range(TRACES)])
            for seed in range(SEEDS)
        ]
        mean = np.mean(by_seed)
        # Seeds are what was sampled: the t interval over their means.
        half = stats.t.ppf(0.975, SEEDS - 1) * np.std(by_seed, ddof=1) / SEEDS**0.5
        assert float(row["mean"]) == pytest.approx(mean, abs=1e-6)
        assert float(row["high"]) - float(row["mean"]) == pytest.approx(half, abs=1e-6)
    # The paper's Table 1, rescue, λ = 1.
    published = {"oracle": 1.73, "qmdp": 0.93, "qhr": 5.86, "baseline": 12.06}
    for column, value in published.items():
        row = found["rescue", "all", 1.0, column]
        assert float(row["paper"]) == value
        assert float(row["difference"]) == pytest.approx(float(row["mean"]) - value, abs=1e-6)


def test_differences_are_paired(known):
    """The oracle's cost and the traces' difficulty cancel: what is left is exact."""
    rows = csv.DictReader(io.StringIO(differences_csv(Summary(known))))
    found = {(r["domain"], float(r["lambda"]), r["method"], r["minus"]): r for r in rows}
    for trade_off in TRADE_OFFS:
        row = found["rescue", trade_off, "qhr", "qmdp"]
        for key in ("mean", "low", "high"):
            assert float(row[key]) == pytest.approx(1.5 * trade_off, abs=1e-6)


def test_tables_do_not_depend_on_the_order_in_which_jobs_ended(sweep):
    before = tables.markdown(Summary(sweep)), tables.latex(Summary(sweep))
    for path in sorted((sweep / "jobs").glob("*/results.json"), reverse=True):
        content = json.loads(path.read_text())
        content["seconds"] = {"explain": 99.0}
        path.unlink()
        path.write_text(json.dumps(content))
    assert (tables.markdown(Summary(sweep)), tables.latex(Summary(sweep))) == before


def test_markdown_and_latex_have_one_row_a_domain_and_trade_off(known):
    summary = Summary(known)
    rows = [row for row in tables.markdown(summary).splitlines() if row.startswith("|")]
    assert len(rows) == 2 + len(SETTINGS) * len(TRADE_OFFS)
    assert len({row.count("|") for row in rows}) == 1
    body = [row for row in tables.latex(summary).splitlines() if row.endswith(r"\\")]
    assert {row.count("&") for row in body if "multicolumn" not in row} == {
        1 + 2 * (1 + len(METHODS))
    }


def test_missing_jobs_are_told_and_incomplete_cells_make_no_curve(sweep):
    lost = "domain=rescue,solver=qmdp,lambda=1,seed=2"
    (sweep / "jobs" / lost / "results.json").unlink()
    failure = {"error": "InputError: <no>", "traceback": ""}
    (sweep / "jobs" / lost / "failure.json").write_text(json.dumps(failure))
    summary = Summary(sweep)
    assert "1 of 36 jobs are missing" in tables.caption(summary)
    main = MainKey("lambda", 10)
    points = {(name, step) for name, step, _ in curves(summary, main)}
    assert ("regret/rescue/qmdp", 10) not in points
    assert ("regret/rescue/qmdp", 5) in points
    _, report = write_report(sweep)
    page = (report / "index.html").read_text()
    assert "InputError: &lt;no&gt;" in page


class Page(html.parser.HTMLParser):
    """Collects what a page would load, and whether its elements close."""

    def __init__(self):
        super().__init__()
        self.loads, self.images, self.open = [], 0, []

    def handle_starttag(self, tag, attrs):
        own = dict(attrs)
        self.loads += [own[key] for key in ("src", "href") if key in own]
        self.images += tag == "img"
        if tag not in ("meta", "img", "link", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_loads_nothing(known):
    report = known / "report"
    text = (report / "index.html").read_text()
    page = Page()
    page.feed(text)
    assert page.open == []
    assert page.images >= 6
    assert all(address.startswith("data:image/") for address in page.loads)
    assert not re.search(r"url\(|@import|<script", text)
    assert "The robot likes &lt;fire&gt;." in text
    for name in ("regret.svg", "messages.svg", "inexplicable.svg", "disagreements.svg"):
        drawing = ElementTree.parse(report / name).getroot()
        lines = drawing.iter(f"{SVG}path")
        drawn = [line for line in lines if line.get("clip-path") and GRID not in line.get("style")]
        # A curve a method and domain, one a domain of the disagreements.
        curves = len(SETTINGS) * (1 if name == "disagreements.svg" else len(METHODS))
        assert len({line.get("d") for line in drawn if "L" in line.get("d")}) >= curves


def test_the_report_is_the_same_bytes_each_time(known):
    report = known / "report"
    before = {path.name: path.read_bytes() for path in report.iterdir()}
    write_report(known)
    assert {path.name: path.read_bytes() for path in report.iterdir()} == before


def test_the_command_finds_the_newest_sweep_and_names_what_is_wrong(sweep, command, tmp_path):
    done = command("xplain report", str(sweep))
    assert done.returncode == 0, done.stderr
    assert "Disaster rescue" in done.stdout
    assert "index.html" in done.stdout
    for arguments in ([], [str(sweep / "jobs")], ["--help-me"]):
        failed = command("xplain report", *arguments)
        assert failed.returncode == 2
        assert len(failed.stderr.strip().splitlines()) == 1
