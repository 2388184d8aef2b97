"""One table in four forms: each contains all texts, and none treats a name as markup."""

import html
import io
import math
import re

import pytest
from rich.console import Console

from xplain.interaction.statistics import Estimate
from xplain.report.table import BEST, TIE, Table, cell, table_of

ODD = "a|b*c <d> & [bold]e[/]"
UNKNOWN = math.nan


def a_table() -> Table:
    rows = [
        {"name": "one", "λ": "1", "value": cell(Estimate(0.5, 0.3, 0.7), BEST), ODD: ""},
        {"name": "one", "λ": "1", "value": cell(Estimate(2.25, UNKNOWN, UNKNOWN)), ODD: "x"},
        {"name": ODD, "λ": "2", "value": cell(Estimate(-0.001, -4, 4), TIE), ODD: ""},
    ]
    return table_of(rows, 2, "How to read it.", "About")


def terminal(table: Table) -> str:
    out = io.StringIO()
    Console(file=out, width=200, highlight=False).print(table.text())
    return out.getvalue()


FORMS = {
    "markdown": Table.markdown,
    "latex": Table.latex,
    "terminal": terminal,
    "page": Table.html,
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_has_every_number_in_the_order_of_the_rows(form: str) -> None:
    text = FORMS[form](a_table())
    sign = r"(?:±|\$\\pm\$)"
    assert re.search(rf"0\.50 {sign} 0\.20.*2\.25.*x.*0\.00 {sign} 4\.00", text, re.DOTALL)
    assert "nan" not in text.lower()
    assert "-0.00" not in text


def test_no_half_reaches_below_what_is_possible() -> None:
    """Costs are at least 0: an interval that ends at 0 is shown by its two ends."""
    assert cell(Estimate(3.5, 0.0, 8.25)) == "3.50 [0.00, 8.25]"


@pytest.mark.parametrize("form", FORMS)
def test_names_are_printed_as_they_are(form: str) -> None:
    text = FORMS[form](a_table())
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


def test_headings_of_the_row_above_are_not_said_again_but_in_markdown() -> None:
    table = a_table()
    assert table.sparse["name"].tolist() == ["one", "", ODD]
    assert table.sparse["λ"].tolist() == ["1", "1", "2"]  # the last heading always stays
    assert table.markdown().count("| one |") == 2
    assert table.latex().count("one") == terminal(table).count("one") == 1


def test_groups_stand_side_by_side_and_below_each_other_on_the_terminal() -> None:
    row = {("", "λ"): "1", ("this", "cost"): "2\n± 1", ("that", "cost"): "3"}
    table = table_of([row], 1)
    assert re.search(r"<th[^>]*>this</th>.*<th[^>]*>that</th>.*2.*3", table.html(), re.DOTALL)
    assert "2<br>± 1" in table.html()
    assert "| λ | this cost | that cost |" in table.markdown()
    assert "|---|---:|---:|" in table.markdown()
    assert "| 1 | 2 ± 1 | 3 |" in table.markdown()
    assert re.search(r"& this & that", table.latex())
    assert re.search(r"this.*λ +cost.*1 +2.*that.*λ +cost.*1 +3", terminal(table), re.DOTALL)
    single = {place: own for place, own in row.items() if place[0] != "that"}
    assert list(table_of([single], 1).frame) == ["λ", "cost"]
