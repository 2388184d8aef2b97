"""The commands behind the door, in the order of the help text."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        module: has ``main(arguments)``, and a docstring that is the command's help; or
            ``module:function``, which is called and has the docstring. What it returns is printed
            as a line of JSON.
        meaning: in a line.
        config: name of its file in conf/, "" where it has none of its own.
        of: study or collect, for a command that both have: what is called takes it first, and it
            stands for NAME in the help. "" for all others.
    """

    module: str
    meaning: str
    config: str = ""
    of: str = ""


COMMANDS = {
    "discover": Command("discover", "find the user types in a table of labels", "discover"),
    "observe": Command("observe", "write labels of simulated observers", "observe"),
    "questions": Command("questions", "what to ask people, as a list", "questions"),
    "plan": Command("plan", "plan for a saved explanation problem", "plan"),
    "export": Command("export", "write a saved problem for POMDP solvers", "export"),
    "report": Command("report", "tables, plots and a page of a sweep, anew"),
    "sync": Command("sync", "send results on disk to MLflow"),
    "demo": Command("demo", "play one explanation, with a simulated user or you"),
    "collect": Command("people:serve", "collect labels from people", "collect", "collect"),
    "collect bots": Command("people:bots", "let simulated people give labels", of="collect"),
    "collect export": Command("people:export", "the labels as tables", of="collect"),
    "collect backup": Command("people:backup", "copy its database, even in use", of="collect"),
    "collect erase": Command("people:erase", "forget a participant", of="collect"),
    "collect replay": Command("people:replay", "compute it again from its log", of="collect"),
    "collect habits": Command("people:habits", "how people listened and answered", of="collect"),
    "study": Command("people:serve", "serve the user study", "study", "study"),
    "study bots": Command("people:bots", "let simulated participants take part", of="study"),
    "study export": Command("people:export", "its data as tables", of="study"),
    "study replay": Command("people:replay", "compute it again from its log", of="study"),
    "study backup": Command("people:backup", "copy its database, even in use", of="study"),
    "study erase": Command("people:erase", "forget a participant", of="study"),
    "study preregister": Command("study:preregister", "a document of the plan, to register"),
    "study analyse": Command("study:analyse", "the paper's Table 2 of its data"),
    "study habits": Command("people:habits", "how participants listened and answered", of="study"),
}
