"""The session on a terminal: map, transitions, messages, labels, belief bars."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.panel import Panel
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from xplain.demo.play import DemoSetup, SimulatedListener, Step, User
from xplain.errors import InputError
from xplain.explanation.asking import Question
from xplain.interaction.session import Session

BAR = 24
PATH, ROBOT = "·", "@"


class Terminal(User):
    """Shows a session step by step, and asks the person at the terminal.

    Args:
        stage: the trace that is explained.
        simulated: who answers; None if the person does.
    """

    def __init__(self, stage: DemoSetup, simulated: SimulatedListener | None = None) -> None:
        width = None if sys.stdout.isatty() else 100
        self.console = Console(highlight=False, width=width)
        self.stage, self.simulated = stage, simulated
        self.user = simulated.user if simulated else None
        self.pauses = simulated is not None and sys.stdin.isatty() and sys.stdout.isatty()
        self._before: dict[str, float] = {}
        self._asked = self._mapped = 0
        self._briefing()

    def _briefing(self) -> None:
        stage = self.stage
        self.console.print(
            f"[bold]{stage.domain}[/] · {stage.solver} · λ = {stage.trade_off:g} · "
            f"{len(stage.prepared.learned_types)} user types were learned"
        )
        if stage.chosen:
            self.console.print(stage.chosen)
        if self.user is not None:
            self.console.print(f"The user is of type [bold]{self.user}[/] (the robot is not told):")
            for sentence in stage.beliefs[self.user]:
                self.console.print(f"  “{sentence}”")
            return
        self.console.print("You are the user. Answer as you like, or as one of the types would:")
        for name, sentences in stage.beliefs.items():
            self.console.print(f"  [bold]{name}[/]  {' '.join(sentences)}")

    def reply(self, session: Session, question: Question) -> int:
        """The answer to a question, which is shown; the map before the first of a step to a person.

        Raises:
            InputError: the input has ended.
        """
        self._asked, self._before = self._asked + 1, self._before or session.belief
        if self.simulated is not None:
            self._question(question)
            value = self.simulated.reply(session, question)
            words = next(words for words, one in question.replies if one == value)
            self.console.print(Panel(words, title="user", title_align="left", expand=False))
            return value
        if self._mapped != session.shown:
            self._mapped = session.shown
            self.console.print()
            self.console.print(self._map(session.shown - 1) or "")
        self._question(question)
        return self._typed_reply(question)

    def _question(self, question: Question) -> None:
        text = f"{question.text}\n[bold]{question.about}[/]" if question.about else question.text
        self.console.print()
        self.console.print(Panel(text, title="robot asks", title_align="left", expand=False))

    def _typed_reply(self, question: Question) -> int:
        """By its number, its words, or their first letter."""
        words = [words for words, _ in question.replies]
        while True:
            for i, text in enumerate(words, 1):
                self.console.print(f"  {i}  {text}")
            typed = self._input("Your answer: [dim](1 or 2)[/]").strip()
            chosen = [
                typed == str(i) or typed.lower() in (t.lower(), t[0].lower())
                for i, t in enumerate(words, 1)
            ]
            if sum(chosen) == 1:
                return question.replies[chosen.index(True)][1]
            self.console.print("  1 or 2, please", style="yellow")

    def _input(self, prompt: str) -> str:
        """Raises InputError where the input has ended."""
        self.console.print(prompt, end=" ")
        try:
            return input()
        except EOFError:
            raise InputError("--me", "end of input", "an answer a step, on a terminal") from None

    def labels(self, session: Session) -> Sequence[int]:
        """Of the trace so far, which is shown with the map and what the robot says.

        Raises:
            InputError: the input has ended.
        """
        k, self._before = session.shown, self._before or session.belief
        self.console.print()
        self.console.print(Rule(f"step {k} of {len(session.trace)}", align="left", style="dim"))
        prepared = self.stage.prepared
        for name in session.messages():
            sentence = prepared.sentences[prepared.messages.index(name)]
            title = "robot, as said before" if name in session.again else "robot"
            self.console.print(Panel(sentence, title=title, title_align="left", expand=False))
        map_ = self._map(k)
        if map_ is not None:
            self.console.print(map_)
        if self.simulated is not None:
            return self.simulated.labels(session)
        self.console.print(self._transitions(k, None))
        return self._typed_labels(k)

    def heard(self, step: Step) -> None:
        """The labels, and how they changed the belief."""
        k = len(step.labels)
        parts: list[RenderableType] = [self._bars(step.belief)]
        if self.user is not None:
            parts.insert(0, self._transitions(k, step.labels))
        self.console.print(Columns(parts, padding=(0, 4)))
        self._before = step.belief
        if k < len(self.stage.case.transitions):
            self._pause()
        else:
            parts_of = "λ · messages + inexplicable labels" + " + κ · questions" * bool(self._asked)
            self.console.print(f"\n[bold]cost {step.cost:g}[/] ({parts_of})")

    def _pause(self) -> None:
        """Waits for a key at each step, if somebody watches at a terminal."""
        if not self.pauses:
            return
        self.console.print("[dim]Enter: the next step; q: all of them[/]", end=" ")
        try:
            self.pauses = input().strip().lower() != "q"
        except EOFError:
            self.pauses = False

    def _typed_labels(self, count: int) -> list[int]:
        while True:
            text = self._input(
                "Which of these make no sense to you? [dim](numbers, such as 1 3; Enter: none)[/]"
            )
            words = text.replace(",", " ").split()
            if all(word.isdecimal() and 1 <= int(word) <= count for word in words):
                wrong = {int(word) for word in words}
                return [0 if i in wrong else 1 for i in range(1, count + 1)]
            self.console.print(f"  numbers between 1 and {count}, please", style="yellow")

    def _transitions(self, k: int, labels: tuple[int, ...] | None) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 1))
        for i, phrase in enumerate(self.stage.case.phrases[:k]):
            mark = Text(" ")
            if labels is not None:
                mark = Text("✓", "blue") if labels[i] else Text("?", "bold dark_orange")
            style = "bold" if i == k - 1 else ""
            table.add_row(f"{i + 1}", mark, Text(phrase, style))
        return table

    def _bars(self, belief: dict[str, float]) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 1))
        table.add_row("", Text("belief", "dim"), "")
        for name, p in belief.items():
            full = round(p * BAR)
            was = self._before[name]
            arrow = "↑" if p > was + 0.005 else "↓" if p < was - 0.005 else " "
            bar = Text("█" * full, "blue") + Text("─" * (BAR - full), "dim")
            # The user's type is highlighted for the audience; the robot is not told.
            style = "bold" if name in self.stage.right(self.user) else ""
            table.add_row(Text(self.stage.title(name), style), bar, f"{p:4.0%} {arrow}")
        return table

    def _changes(self, k: int) -> RenderableType | None:
        """What each transition shown so far has changed; None if the domain does not say it."""
        case = self.stage.case
        if not case.changes:
            return None
        lines = zip(case.phrases[:k], case.changes[:k], strict=True)
        return Group(
            *(
                Text.assemble(f"{i}. {phrase}", (f"  {'; '.join(changes)}", "dim"))
                for i, (phrase, changes) in enumerate(lines, 1)
            )
        )

    def _map(self, k: int) -> RenderableType | None:
        scene, positions = self.stage.prepared.scene, self.stage.case.positions
        if scene is None or len(positions) <= k:
            return self._changes(k)
        grid = [[Text(".", "dim") for _ in range(scene.columns)] for _ in range(scene.rows)]
        for row, column in scene.walls:
            grid[row][column] = Text("█", "grey50")
        for item in scene.items:
            for row, column in item.cells:
                grid[row][column] = Text(item.symbol, "bold green")
        for row, column in positions[:k]:
            if grid[row][column].plain == ".":
                grid[row][column] = Text(PATH, "bold blue")
        row, column = positions[k]
        grid[row][column] = Text(ROBOT, "bold reverse blue")
        lines = [Text(" ").join(line) for line in grid]
        legend = Text("  ".join(f"{item.symbol} {item.name}" for item in scene.items), "dim")
        return Group(*lines, legend)
