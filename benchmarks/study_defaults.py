"""Measures the cost of a study's labeler and belief to its participants (docs/study.md).

    python benchmarks/study_defaults.py              both of the paper's domains, 12 seeds
    python benchmarks/study_defaults.py --seeds 3    three seeds
    python benchmarks/study_defaults.py --quick      a smoke run

Types, observers and policy (personalized) are the study's. Each seed has the five traces for which
the types need most messages; costs count true labels.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from explainees import DOMAINS, figure, ratio
from hydra.utils import instantiate

from xplain.experiment.config import compose_config
from xplain.explanation.anybody import Open
from xplain.explanation.belief import Independent
from xplain.explanation.label_table import LabelTable
from xplain.interaction.episode import explain
from xplain.interaction.explainees import Exact, Explainee, Slips
from xplain.people.material import Material, learn_domain_types, select_plan_keys
from xplain.people.study.flow import Study
from xplain.people.study.plan import PERSONALIZED
from xplain.people.study.prepare import make_draft, make_learned_table, traces_of
from xplain.randomness import derive_seed

FIRST = 9600
"""The first seed; nothing was chosen on this or later seeds."""
SMALL = ("points=20", "users.count=2", "max_steps=6", "trace.candidates=5")
"""Changes for a smoke run."""
LABELERS = ("tree", "hypotheses")
BELIEFS = {"the paper's": Independent(), "the study's": Open("learned")}
PEOPLE: dict[str, Explainee] = {
    "never": Exact(),
    "10%, repeated mistakes": Slips(0.1, repeats=True),
}


def paid(study: Study, explainee: Explainee, seed: int) -> float:
    """Returns the mean cost of one person of each type."""
    problem, policy = study.plan.problem_of(PERSONALIZED), study.policies[PERSONALIZED]
    costs = []
    for kind, labels in enumerate(study.plan.true_labels):
        same, own = np.arange(len(labels)), derive_seed(seed, "p", kind)
        person = explainee.meet(LabelTable.dense(labels[None]), same, own)
        costs.append(explain(problem, policy, person, study.belief).cost)
    return float(np.mean(costs))


def measured(
    domain: str, labeler: str, seed: int, traces: int, *small: str
) -> dict[tuple[str, str], float]:
    """Returns the mean cost of a seed, by belief and people."""
    choices = [f"domain={domain}", f"seed={seed}", f"labeler={labeler}", *small]
    cfg = compose_config("study", choices)
    config: dict[str, Any] = select_plan_keys(cfg)
    setting, learned = learn_domain_types(cfg, instantiate(cfg.domain))
    task, found = Material.of(setting), defaultdict[tuple[str, str], list[float]](list)
    best = traces_of(task, config["trace"], config["max_steps"], seed)[:traces]
    for number, trace in enumerate(best):
        for name, belief in BELIEFS.items():
            kind = f"{type(belief).__module__}.{type(belief).__name__}"
            own = {**config, "belief": {"_target_": kind, "error": belief.error}}
            study = Study.of(
                make_draft(task, trace, make_learned_table(task, learned, trace), own, learned)
            )
            for people, explainee in PEOPLE.items():
                cost = paid(study, explainee, derive_seed(seed, "people", number))
                found[name, people].append(cost)
    return {key: float(np.mean(costs)) for key, costs in found.items()}


def table(seeds: Iterable[int], traces: int, *small: str, domains: Sequence[str] = DOMAINS) -> None:
    """Prints the costs, and the ratio of the study's cost to the paper's."""
    print("| people err | labels learned by | the paper's belief | the study's | study / paper |")
    print("|---|---|---|---|---|")
    for domain in domains:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 4)
        found: dict[tuple[str, str, str], list[float]] = defaultdict(list)
        for seed in seeds:
            for labeler in LABELERS:
                costs = measured(domain, labeler, seed, traces, *small)
                for (belief, people), cost in costs.items():
                    found[people, labeler, belief].append(cost)
        for people in PEOPLE:
            for labeler in LABELERS:
                paper, own = (found[people, labeler, belief] for belief in BELIEFS)
                cells = f"{figure(paper)} | {figure(own)} | {ratio(own, paper)}"
                print(f"| {people} | {labeler} | {cells} |", flush=True)


def main() -> None:
    """Prints the table, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--seeds", type=int, default=12)
    options = parser.parse_args()
    if options.quick:
        table([FIRST], 1, *SMALL, domains=["four_rooms"])
    else:
        table(range(FIRST, FIRST + options.seeds), 5)


if __name__ == "__main__":
    main()
