"""A table that people read, and its four forms: Markdown, LaTeX, the terminal, the page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from xplain.interaction.statistics import Estimate
from xplain.report.summary import is_number

if TYPE_CHECKING:
    from rich.table import Table as Shown

BEST, TIE = "*", "≈"

CUT = 0.01
"""Halves of an interval that differ by more than this are unequal: numbers have two decimals."""


_TEX = str.maketrans(
    {sign: rf"\{sign}" for sign in "_%&#${}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"λ": r"$\lambda$", "−": "$-$"}
)


@dataclass(frozen=True)
class Cell:
    """One place of a table.

    Attributes:
        words: what stands there, of an estimate nothing.
        estimate: a number with its interval.
        mark: BEST, TIE or nothing.
        paper: the paper's number; NaN where it has none.
        note: said beside the words, in small print where there is any.
        look: ``yes`` or ``no``: the colour of the words on the page.
    """

    words: str = ""
    estimate: Estimate | None = None
    mark: str = ""
    paper: float = math.nan
    note: str = ""
    look: str = ""

    @property
    def main(self) -> str:
        """The words, or the mean."""
        return self.words if self.estimate is None else number(self.estimate.mean)

    @property
    def ends(self) -> str:
        """The interval, such as ``[0.31, 0.73]``."""
        return "" if self.estimate is None else interval(self.estimate)

    @property
    def half(self) -> str:
        """Half of the interval, such as ``± 0.21``; its ends where a bound cuts one half."""
        if self.estimate is None:
            return ""
        above = self.estimate.high - self.estimate.mean
        if above - (self.estimate.mean - self.estimate.low) > CUT:
            return self.ends
        half = number(above)
        return half and f"± {half}"

    @property
    def beside(self) -> str:
        """The note, or the paper's number and our difference to it: ``paper 0.46, +0.06``."""
        if self.estimate is None or math.isnan(self.paper):
            return self.note
        return f"paper {self.paper:.2f}, {self.estimate.mean - self.paper:+z.2f}"


@dataclass(frozen=True)
class Table:
    """Row headings in words, and numbers beside them.

    Attributes:
        heads: of the columns.
        rows: as long as ``heads``, each.
        left: how many columns are words and stand at the left.
        caption: how to read it.
        about: what all of it has in common.
        halves: intervals are told as halves of their widths, not by their ends.
    """

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    left: int
    caption: str = ""
    about: str = ""
    halves: bool = False

    def spread(self, cell: Cell) -> str:
        """The interval of a cell, in the table's way."""
        return cell.half if self.halves else cell.ends

    def text(self, cell: Cell) -> str:
        """``0.52 ± 0.21 *`` or ``0.52 [0.31, 0.73] (paper 0.46, +0.06)``."""
        beside = cell.beside and f"({cell.beside})"
        return " ".join(filter(None, [cell.main, self.spread(cell), beside, cell.mark]))

    @property
    def body(self) -> Iterator[tuple[Cell, ...]]:
        """The rows without headings that stand in the row above already."""
        before: tuple[Cell, ...] = ()
        for row in self.rows:
            same = 0
            while same < self.left - 1 and before and before[same].words == row[same].words:
                same += 1
            yield (*[Cell()] * same, *row[same:])
            before = row

    def markdown(self) -> str:
        """With what it is about and its caption."""
        lines = [self.heads, *([self.text(cell) for cell in row] for row in self.rows)]
        rows = ["| " + " | ".join(word.replace("|", r"\|") for word in own) + " |" for own in lines]
        rows.insert(1, "|" + "---|" * self.left + "---:|" * (len(self.heads) - self.left))
        parts = [self.about, "\n".join(rows), self.caption]
        return "\n\n".join(filter(None, parts)).replace("*", r"\*") + "\n"

    def latex(self) -> str:
        """For a paper (booktabs), the best of each row in bold; what else is said is a comment."""
        lines = [
            r"% \usepackage{booktabs}",
            rf"\begin{{tabular}}{{{'l' * self.left}{'r' * (len(self.heads) - self.left)}}}",
            r"\toprule",
            " & ".join(map(tex, self.heads)) + r" \\",
            r"\midrule",
        ]
        for i, row in enumerate(self.body):
            lines += [r"\midrule"] if i and self.left > 1 and row[0].words else []
            lines.append(" & ".join(map(self._tex, row)) + r" \\")
        said = ". ".join(filter(None, [self.about, self.caption]))
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", f"% {said}"]) + "\n"

    def _tex(self, cell: Cell) -> str:
        if cell.estimate is None:
            return tex(self.text(cell))
        spread = self.spread(cell).replace("±", r"\pm")
        if self.halves:
            text = " ".join(filter(None, [cell.main, spread]))
            text = rf"$\mathbf{{{text}}}$" if cell.mark == BEST else f"${text}$"
            text += r" $\approx$" if cell.mark == TIE else ""
            return rf"\shortstack[r]{{{text}\\\tiny {tex(cell.note)}}}" if cell.note else text
        above = f"${cell.main}$" + ("" if math.isnan(cell.paper) else f" ({cell.paper:.2f})")
        return rf"\shortstack[r]{{{above}\\\tiny${spread}$}}" if spread else above

    def shown(self) -> Shown:
        """For the terminal: what does not stand in one line stands in two."""
        from rich.table import Table as Shown
        from rich.text import Text

        table = Shown(box=None, pad_edge=False)
        for i, head in enumerate(self.heads):
            words = [row[i].words for row in self.rows]
            at_left = i < self.left and not all(map(is_number, words))
            table.add_column(Text(head), justify="left" if at_left else "right")
        marked = any(cell.mark for row in self.rows for cell in row)
        for i, row in enumerate(self.body):
            if i and self.left > 1 and row[0].words:
                table.add_section()
            cells = [Text(self._shown(cell)) for cell in row]
            for cell, text in zip(row[self.left :], cells[self.left :], strict=True):
                # Marks stand below each other, beside the numbers.
                text.append("  " if marked and not cell.mark else "")
                text.stylize("bold" if cell.mark == BEST else "")
            table.add_row(*cells)
        return table

    def _shown(self, cell: Cell) -> str:
        if cell.estimate is None:
            return self.text(cell)
        if self.halves:
            return "\n".join(filter(None, [self.text(replace(cell, note="")), cell.note]))
        paper = "" if math.isnan(cell.paper) else f" ({cell.paper:.2f})"
        return "\n".join(filter(None, [cell.main + paper, cell.ends]))


def number(value: float) -> str:
    """Two decimals, never a negative zero; empty where there is none."""
    return "" if math.isnan(value) else f"{value:z.2f}"


def interval(estimate: Estimate) -> str:
    """The ends of the interval; empty where they are not known."""
    known = not math.isnan(estimate.low)
    return f"[{number(estimate.low)}, {number(estimate.high)}]" if known else ""


def tex(text: str) -> str:
    """Text that LaTeX prints as it is: none of it is a command."""
    return text.translate(_TEX)
