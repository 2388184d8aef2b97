"""A readable table: a pandas frame of texts, printed as text, Markdown, LaTeX and HTML."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from xplain.interaction.statistics import Estimate

if TYPE_CHECKING:
    from rich.console import Group

BEST, TIE = "*", "≈"

CUT = 0.01
"""If the two halves of an interval differ by more than this, both ends are shown. (Numbers have two
decimals.)"""

_TEX = str.maketrans(
    {"λ": r"$\lambda$", "−": "$-$", "±": r"$\pm$", "≈": r"$\approx$", "†": r"$\dagger$"}
)


@dataclass(frozen=True)
class Table:
    """Row headings and numbers as texts.

    Attributes:
        frame: texts; columns in groups have two levels.
        left: number of columns with row headings.
        caption: explains how to read the table.
        about: settings that all rows share.
    """

    frame: pd.DataFrame
    left: int
    caption: str = ""
    about: str = ""

    @property
    def sparse(self) -> pd.DataFrame:
        """The frame, in which a row heading is empty if it repeats the heading above. The last
        column of headings is always complete."""
        heads = self.frame.iloc[:, : self.left - 1]
        same = (heads == heads.shift()).cumprod(axis=1).astype(bool)
        found = self.frame.copy()
        found[heads.columns] = heads.mask(same, "")
        return found

    def markdown(self) -> str:
        """Formats the table in Markdown, with ``about`` and its caption."""
        names: list[Any] = list(self.frame)
        heads = [own if isinstance(own, str) else " ".join(filter(None, own)) for own in names]
        lines = [heads, *self.frame.to_numpy().tolist()]
        rows = [
            "| " + " | ".join(w.replace("|", r"\|").replace("\n", " ") for w in own) + " |"
            for own in lines
        ]
        rows.insert(1, "|" + "---|" * self.left + "---:|" * (len(heads) - self.left))
        parts = [self.about, "\n".join(rows), self.caption]
        return "\n\n".join(filter(None, parts)).replace("*", r"\*") + "\n"

    def latex(self) -> str:
        """Formats the table for a paper (booktabs), with ``about`` and the caption as comments."""
        columns = "l" * self.left + "r" * (self.frame.shape[1] - self.left)
        flat = self.sparse.replace("\n", " ", regex=True)
        text = flat.to_latex(index=False, column_format=columns, escape=True).translate(_TEX)
        said = " ".join(filter(None, [self.about and f"{self.about}.", self.caption]))
        return "\n".join([r"% \usepackage{booktabs}", f"{text}% {said}", ""])

    def html(self) -> str:
        """Formats the table as HTML, without ``about`` and the caption. The HTML class gives the
        number of heading columns."""
        kind = f"left{self.left}"
        # pandas would write a line break as a backslash and a letter.
        lines = self.sparse.replace("\n", "\u2028", regex=True)
        text = lines.to_html(index=False, border=0, classes=kind, justify="unset")
        return str(text).replace("\u2028", "<br>")

    def text(self) -> Group:
        """Formats the table for the terminal: one table for each group of columns, all with the row
        headings."""
        from rich.console import Group
        from rich.table import Table as Shown
        from rich.text import Text

        frame, shown = self.sparse, []
        names, is_grouped = frame.columns.get_level_values(0), frame.columns.nlevels > 1
        for group in [name for name in dict.fromkeys(names) if name] if is_grouped else [""]:
            title = Text(group, "bold") if group else None
            one = Shown(box=None, pad_edge=False, title=title, title_justify="left")
            own = frame.loc[:, names.isin(["", group])] if is_grouped else frame
            for i, head in enumerate(own.columns.get_level_values(-1)):
                one.add_column(Text(head), justify="left" if i < self.left else "right")
            for row in own.itertuples(index=False):
                one.add_row(*map(Text, row))
            shown.append(one)
        return Group(*shown)


def table_of(
    rows: list[dict[str, str]] | list[dict[tuple[str, str], str]],
    left: int,
    caption: str = "",
    about: str = "",
) -> Table:
    """Makes a table from rows. The keys of a row are the headings of its columns: texts, or pairs
    (group, heading). The name of a single group is left out."""
    frame = pd.DataFrame(rows, dtype=object).fillna("")
    if rows and isinstance(next(iter(rows[0])), tuple):
        columns = pd.MultiIndex.from_tuples([*frame])
        several = len({group for group, _ in columns} - {""}) > 1
        frame.columns = columns if several else columns.get_level_values(1)
    return Table(frame, left, caption, about)


def cell(estimate: Estimate, after: str = "", below: str = "", split: bool = False) -> str:
    """Formats a mean with its interval: ``0.52 ± 0.21 *``; "" without an estimate.

    Args:
        estimate: mean and interval of a measure.
        after: text after the number, such as a mark.
        below: text of a second line.
        split: True puts the interval on its own line.
    """
    if math.isnan(estimate.mean):
        return ""
    mean, width = number(estimate.mean), half(estimate)
    words = [f"{mean} {after}".strip(), width] if split else [f"{mean} {width} {after}".strip()]
    return "\n".join(filter(None, [*(" ".join(w.split()) for w in words), below]))


def half(estimate: Estimate) -> str:
    """Formats half of the interval's width, such as ``± 0.21``. Formats both ends if the mean is
    not in the middle, because the lower end was clipped to the lowest possible value."""
    above = estimate.high - estimate.mean
    if above - (estimate.mean - estimate.low) > CUT:
        return interval(estimate)
    return "" if math.isnan(above) else f"± {number(above)}"


def number(value: float) -> str:
    """Formats a number with two decimals, never a negative zero; NaN becomes empty."""
    return "" if math.isnan(value) else f"{value:z.2f}"


def interval(estimate: Estimate) -> str:
    """Formats the ends of the interval; "" if unknown."""
    known = not math.isnan(estimate.low)
    return f"[{number(estimate.low)}, {number(estimate.high)}]" if known else ""


def count_things(amount: int, what: str) -> str:
    """Formats an amount: ``no message``, ``1 message``, ``2 messages``."""
    return f"{amount or 'no'} {what}{'' if amount == 1 else 's'}"
