"""A document to register before the first participant: ``study preregister``.

Everything in it follows from the plan, so that what is registered is what runs.
"""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined

from xplain.people.study.analysis import MEASURES, SECONDARY
from xplain.people.study.plan import ASKING, StudyPlan
from xplain.people.study.policies import difference

DIRECTION = {
    "interaction_time_s": "less time",
    "inexplicable_transitions": "fewer steps that make no sense",
    "quiz_score": "a higher score",
}
MEANING = {
    "interaction_time_s": "seconds from the first rendering of the first step to the last accepted "
    "label, by the server's clock",
    "inexplicable_transitions": "steps labelled as making no sense, in the labels at the last step",
    "quiz_score": "statements judged rightly in the last test",
    "visible_time_s": "the first measure less the time in which no page of the study was visible",
    "messages_given": "messages that the robot sent, each counted once",
    "messages_again": "how often it said one of them again",
    "questions_asked": "steps that the robot asked about in between",
    "cost": "λ · messages + inexplicable labels of all steps + κ · questions, as the policies plan",
}


def document(plan: StudyPlan) -> str:
    """Hypotheses, design, measures, exclusions, analysis and sample size, in Markdown."""
    loader = PackageLoader("xplain.people.study")
    written = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True)
    asks, secondary = ASKING in plan.conditions, dict(SECONDARY)
    if plan.problem.messages_land:
        del secondary["messages_again"]
    if not asks:
        del secondary["questions_asked"]
    return written.get_template("preregistration.md").render(
        plan=plan,
        asks=asks,
        asked=plan.problem.questions,
        difference=difference(plan),
        primary=MEASURES,
        secondary=secondary,
        direction=DIRECTION,
        meaning=MEANING,
    )
