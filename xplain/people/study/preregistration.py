"""A document to register before the first participant: ``study preregister``.

Everything in it follows from the plan, so that what is registered is what runs.
"""

from __future__ import annotations

from collections.abc import Sequence

from xplain.people.plan import Asked
from xplain.people.study.plan import ASKING, PERSONALIZED, StudyPlan
from xplain.people.study.policies import difference
from xplain.people.study.statistics import t_power
from xplain.people.study.table2 import CONDITIONS, MEASURES, SECONDARY, paper_effect

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


AGAIN = (
    "A policy that listens to the answers may say a message again that seems not to have landed; "
    "the page marks it as said before."
)


def document(plan: StudyPlan) -> str:
    """Hypotheses, design, measures, exclusions, analysis and sample size, in Markdown."""
    return "\n\n".join(
        [
            f"# Preregistration: {plan.texts.title}",
            f"Plan `{plan.hash}`, domain {plan.domain}, seed {plan.seed}.",
            *_hypotheses(plan),
            *_design(plan),
            *_measures(plan),
            *_exclusions(plan),
            *_analysis(plan),
            *_sample(plan),
            "",
        ]
    )


def _hypotheses(plan: StudyPlan) -> list[str]:
    said = {m: f"{DIRECTION[m]} ({title.lower()})" for m, title in MEASURES.items()}
    rows = [
        f"{number}. Participants who get personalized messages need, or have, {what} than those "
        "who get conformant messages."
        for number, what in enumerate(said.values(), 1)
    ]
    if ASKING in plan.conditions:  # questions take time
        rows += [
            f"{number}. Participants who are asked in between have {said[measure]} than those who "
            "get personalized messages without questions."
            for number, measure in enumerate([*MEASURES][1:], len(rows) + 1)
        ]
    return ["## Hypotheses", "\n".join(rows)]


def _design(plan: StudyPlan) -> list[str]:
    solvers = [
        f"- *{name}*: {str(solver['_target_']).rpartition('.')[2]}"
        for name, solver in plan.conditions.items()
    ]
    types = [
        f"- {role.name}: told wrongly {', '.join(plan.facts[j].name for j in role.wrong)}"
        for role in plan.roles
    ]
    return [
        "## Design",
        f"Between subjects: {len(plan.roles)} user types × {len(plan.conditions)} conditions, "
        "assigned in permuted blocks of every cell once; participants are not told of types or "
        "conditions, and the researcher's page hides them.",
        "\n".join(solvers),
        *([AGAIN] if plan.problem.tracks_knowledge else []),
        *_questions_of(plan),
        f"On this plan a faultless participant gets {difference(plan):.1f} "
        f"messages{' or questions' * (ASKING in plan.conditions)} more or fewer "
        "in one condition than in the other, on average over the types. Types:",
        "\n".join(types),
        f"Every participant evaluates the same {plan.n_steps} steps:",
        "\n".join(f"{k}. {phrase}" for k, phrase in enumerate(plan.trace, 1)),
    ]


def _questions_of(plan: StudyPlan) -> list[str]:
    asked = plan.problem.questions
    if asked is None:
        return []
    limits = asked.limits
    when = "before any step" if limits.when == "anytime" else "before the first step"
    return [
        f"In *{ASKING}* the policy may ask about {limits.most} of {len(asked)} steps of the task "
        f"at most, {when}; it takes a question to cost {limits.cost:g} of an inexplicable label."
    ]


def _measures(plan: StudyPlan) -> list[str]:
    rows = [
        f"- {title} (`{measure}`{', secondary' * (measure in SECONDARY)}): {MEANING[measure]}."
        for measure, title in {**MEASURES, **SECONDARY}.items()
        if (measure != "messages_again" or plan.problem.tracks_knowledge)
        and (measure != "questions_asked" or ASKING in plan.conditions)
    ]
    found = ["## Measures", "\n".join(rows)]
    for when, questions in (("Before the briefing", plan.before), ("After the quiz", plan.asked)):
        if questions:
            found.append(f"{when}: {_questions(questions)}.")
    return found


def _questions(questions: Sequence[Asked]) -> str:
    return "; ".join(f"“{q.label}” ({q.kind}, `{q.name}`)" for q in questions)


def _exclusions(plan: StudyPlan) -> list[str]:
    rules = plan.rules
    rows = [
        f"- The check after the briefing failed {rules.max_attempts} times: the part ends.",
        f"- Silent for {rules.timeout_minutes:g} minutes: the place is offered to others; who "
        "comes back while places are free goes on, and their number is reported.",
        "- Left before the end, or data erased at their wish.",
    ]
    if rules.min_width:
        rows.append(f"- Windows of less than {rules.min_width} pixels are not let in.")
    rows += [
        f"- “{q.label}” answered otherwise than “{q.right}” before the briefing: the part ends."
        for q in plan.before
        if q.right
    ]
    rows += [
        f"- “{q.label}” answered otherwise than “{q.right}” after the quiz: not analysed."
        for q in plan.asked
        if q.right
    ]
    rows.append("- Anything else is decided, with its reason, before results are looked at.")
    return ["## Exclusions", "\n".join(rows)]


def _analysis(plan: StudyPlan) -> list[str]:
    also = (
        f" {PERSONALIZED.capitalize()} against {ASKING} in the same way, with a correction over "
        "its own three measures."
    ) * (ASKING in plan.conditions)
    return [
        "## Analysis",
        f"Student's t test (two-sided) of each of the {len(MEASURES)} primary measures, "
        f"{CONDITIONS[0]} against {CONDITIONS[1]}; Holm's correction over them, α = .05. Beside "
        "them: Welch's t test, Hedges' g with its 95 % interval, and a permutation test stratified "
        f"by type.{also} Pilots and simulated participants are never in it. Computed by `xplain "
        "study analyse`, after `xplain study replay` has found the log unchanged.",
    ]


def _sample(plan: StudyPlan) -> list[str]:
    size = plan.rules.per_cell * len(plan.roles)
    rows = [
        "| measure | d of the paper's p | power | power at α/3 |",
        "|---|---|---|---|",
    ]
    for measure, title in MEASURES.items():
        d = abs(paper_effect(measure))
        plain, strict = t_power(d, size), t_power(d, size, 0.05 / len(MEASURES))
        rows.append(f"| {title} | {d:.2f} | {plain:.2f} | {strict:.2f} |")
    return [
        "## Sample size",
        f"{plan.rules.per_cell} who finish in each of {len(plan.cells)} cells: {size} a condition, "
        f"{plan.rules.per_cell * len(plan.cells)} in all. Collection ends when every place is "
        "used. Power with so many, for effects as large as those of the published study:",
        "\n".join(rows),
    ]
