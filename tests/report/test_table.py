"""One table, four forms: each says what is in it, and none takes a name for a command."""

from __future__ import annotations

import html
import io
import math
import re
from importlib.resources import files

import numpy as np
import pytest
from jinja2 import Environment, StrictUndefined
from rich.console import Console

from xplain.interaction.statistics import Estimate
from xplain.report.table import BEST, TIE, Cell, Table, number

ODD = "a|b*c <d> & [bold]e[/]"
UNKNOWN = math.nan


def a_table(halves: bool) -> Table:
    small = Estimate(-0.001, -4, 4)
    rows = [
        (Cell("one"), Cell("1"), Cell(estimate=Estimate(0.5, 0.3, 0.7), mark=BEST), Cell()),
        (Cell("one"), Cell("2"), Cell(estimate=Estimate(2.25, UNKNOWN, UNKNOWN)), Cell("x")),
        (
            Cell(ODD),
            Cell("2"),
            Cell(estimate=small, mark=TIE, paper=0.25),
            Cell(),
        ),
    ]
    return Table(("name", "λ", "value", ODD), tuple(rows), 2, "How to read it.", "About", halves)


def terminal(table: Table) -> str:
    out = io.StringIO()
    Console(file=out, width=200, highlight=False).print(table.shown())
    return out.getvalue()


def page(table: Table) -> str:
    source = files("xplain.report").joinpath("page.html").read_text(encoding="utf-8")
    macros = source[: source.index("<!doctype")]
    template = Environment(autoescape=True, undefined=StrictUndefined)
    return template.from_string(macros + "{{ grid(table) }}").render(table=table)


FORMS = {
    "markdown": Table.markdown,
    "latex": Table.latex,
    "terminal": terminal,
    "page": page,
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("halves", [True, False])
def test_every_form_has_every_number_in_the_order_of_the_rows(form: str, halves: bool) -> None:
    text = FORMS[form](a_table(halves))
    spread = r"(?:±|\\pm) 0\.20" if halves else r"\[0\.30, 0\.70\]"
    wide = r"(?:±|\\pm) 4\.00" if halves else r"\[-4\.00, 4\.00\]"
    assert re.search(rf"0\.50.*{spread}.*2\.25.*x.*0\.00.*{wide}", text, re.DOTALL)
    assert "nan" not in text
    assert "-0.00" not in text


@pytest.mark.parametrize("form", FORMS)
def test_no_half_reaches_below_what_is_possible(form: str) -> None:
    """Costs are at least 0: an interval that ends there is told by its ends."""
    row = (Cell("one"), Cell(estimate=Estimate(3.5, 0.0, 8.25)))
    text = FORMS[form](Table(("name", "cost"), (row,), 1, halves=True))
    assert "[0.00, 8.25]" in text
    assert "±" not in text
    assert r"\pm" not in text


@pytest.mark.parametrize("form", FORMS)
def test_names_are_printed_as_they_are(form: str) -> None:
    text = FORMS[form](a_table(True))
    if form == "markdown":  # a bar would end the cell, stars would be emphasis
        assert not re.search(r"(?<!\\)\*", text)
        lines = [re.sub(r"\\[|*]", "", line) for line in text.splitlines() if line.startswith("|")]
        assert {line.count("|") for line in lines} == {5}
        text = re.sub(r"\\([|*])", r"\1", text)
    elif form == "latex":
        assert r"a|b*c <d> \& [bold]e[/]" in text
        text = text.replace(r"\&", "&")
    elif form == "page":
        assert "<d>" not in text
        text = html.unescape(text)
    assert text.count(ODD) == 2


def test_what_stands_above_is_not_said_again_but_in_markdown() -> None:
    table = a_table(False)
    assert [row[0].words for row in table.body] == ["one", "", ODD]
    assert table.markdown().count("| one |") == 2
    assert table.latex().count("one") == terminal(table).count("one") == 1
    assert [row[1].words for row in table.body] == ["1", "2", "2"]
    # The last heading of a row is never left out.
    alike = Table(("name", "value"), ((Cell("one"), Cell("1")), (Cell("one"), Cell("2"))), 1)
    assert [row[0].words for row in alike.body] == ["one", "one"]


def test_the_best_is_bold_and_the_paper_stands_beside() -> None:
    marked, plain = a_table(True), a_table(False)
    assert r"$\mathbf{0.50 \pm 0.20}$" in marked.latex()
    assert '<b class="best">0.50</b>' in page(marked)
    assert "-0.00 [-4.00, 4.00] (paper 0.25, -0.25)" not in plain.markdown()
    assert "0.00 [-4.00, 4.00] (paper 0.25, -0.25)" in plain.markdown()
    assert "0.00 (0.25)" in terminal(plain)


def test_numbers_have_two_decimals_and_no_negative_zero() -> None:
    for value in np.linspace(-0.02, 0.02, 81):
        text = number(float(value))
        assert abs(float(text) - value) <= 0.005 + 1e-12
        assert text != "-0.00"
    assert number(UNKNOWN) == ""


def test_latex_has_a_rule_between_groups_of_rows_and_no_other() -> None:
    """A row whose first cell is filled begins a group, where there is more than one to the left."""
    table = a_table(True)
    grouped = [row[0].words != "" for row in table.body]
    rules = [line for line in table.latex().splitlines() if line.endswith("rule")]
    assert rules.count(r"\midrule") == 1 + sum(grouped[1:])
    single = Table(table.heads[1:], tuple(row[1:] for row in table.rows), 1, "", "", True)
    assert single.latex().count(r"\midrule") == 1
