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
    """

    module: str
    meaning: str
    config: str = ""


COMMANDS = {
    "discover": Command("discover", "find the user types in a table of labels", "discover"),
    "observe": Command("observe", "write labels of simulated observers", "observe"),
    "questions": Command("questions", "what to ask people, as a list", "questions"),
    "plan": Command("plan", "plan for a saved explanation problem", "plan"),
    "export": Command("export", "write a saved problem for POMDP solvers", "export"),
    "report": Command("report", "tables, plots and a page of a sweep, anew"),
    "sync": Command("sync", "send results on disk to MLflow"),
    "demo": Command("demo", "play one explanation, with a simulated user or you"),
    "collect": Command("collect:serve", "collect labels from people", "collect"),
    "collect bots": Command("collect:bots", "let simulated people give labels"),
    "collect export": Command("collect:export", "the labels as tables"),
    "collect erase": Command("collect:erase", "forget a participant"),
    "collect replay": Command("collect:replay", "compute it again from its log"),
    "collect habits": Command("collect:habits", "how people listened and answered"),
    "study": Command("study:serve", "serve the user study", "study"),
    "study bots": Command("study:bots", "let simulated participants take part"),
    "study export": Command("study:export", "its data as tables"),
    "study replay": Command("study:replay", "compute it again from its log"),
    "study erase": Command("study:erase", "forget a participant"),
    "study preregister": Command("study:preregister", "a document of the plan, to register"),
    "study analyse": Command("study:analyse", "the paper's Table 2 of its data"),
    "study habits": Command("study:habits", "how its participants listened and answered"),
    "study power": Command("study:power", "how many participants it needs"),
}
