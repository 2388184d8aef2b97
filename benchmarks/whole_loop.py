"""Runs the whole method with simulated people: labels, types, and a study without a briefing.

24 people answer 20 adaptive questions each, 5 % of them wrongly, and ``discover`` finds the types.
The policies of a study know only these types; other simulated people take part without a briefing,
in the conditions *personalized* and *conformant*. Both protocols run without pages. The aim is
fewer messages in the personalized condition, without more inexplicable steps.

    python benchmarks/whole_loop.py [--domain rescue] [--seeds 5] [--people 20] [--quick]
"""

import argparse
import contextlib
import io
import sys
import tempfile
from pathlib import Path

import pandas as pd

import xplain
from xplain.errors import InputError
from xplain.experiment.config import compose_config
from xplain.interaction.statistics import clustered_mean
from xplain.learning.data.label_file import write_table
from xplain.people.collect.bot import Habits as Observing
from xplain.people.collect.plan import CollectPlan, CollectRules
from xplain.people.collect.prepare import assemble, material_of
from xplain.people.collect.tables import dataset_of
from xplain.people.material import select_plan_keys
from xplain.people.study.analysis import CONDITIONS
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import study_plan
from xplain.questions.designs import Adaptive
from xplain.randomness import stream

sys.path.insert(0, str(Path(__file__).parent.parent))

from tests.people.bare_flow import crowd, take_part, truth_of

LABELS, PEOPLE, ERROR = 20, 24, 0.05
HABITS = {
    "people without errors": Habits(0, 0, 0, 0, mistake=0),
    "people who err in 3 %, forget, and learn less from each of many messages": Habits(),
}
MEASURES = ["messages", "inexplicable", "score", "seconds"]


def collection(domain: str, seed: int) -> CollectPlan:
    """Makes the plan of ``collect``."""
    cfg = compose_config("collect", [f"domain={domain}", f"points={LABELS}", f"seed={seed}"])
    config = select_plan_keys(cfg)
    rules = CollectRules(points=LABELS, **config["rules"])
    return assemble(material_of(cfg), Adaptive(), rules, config)


def found_types(plan: CollectPlan, folder: Path, seed: int) -> tuple[Path, float]:
    """Finds the types in the labels of simulated people. Returns the file of the types, and the
    adjusted Rand index."""
    from sklearn.metrics import adjusted_rand_score

    states = crowd(plan, PEOPLE, Observing(error=ERROR, mistake=0.0), seed)
    kept = {f"{i:03d}": state for i, state in enumerate(states) if not state.left_out}
    write_table(dataset_of(plan, kept), folder / "labels.csv")
    (plan.whole or plan.hypotheses).save(folder / "hypotheses.npz")
    given = {"labeler": "hypotheses", "hypotheses": f"{folder}/hypotheses.npz", "held_out": False}
    row = xplain.discover(folder / "labels.csv", **given, output=folder / "found").row
    truth = truth_of(plan, PEOPLE)[[int(who) for who in kept]]
    found = [row["assignment"][who] for who in kept]
    return folder / "found" / "types.npz", float(adjusted_rand_score(truth, found))


def study(domain: str, types: Path, seed: int) -> StudyPlan:
    """Makes the plan of a study without a briefing, whose policies know these types."""
    given = [f"domain={domain}", f"types={types}", "briefing=none", f"seed={seed}"]
    return study_plan(compose_config("study", given))


def took_part(plan: StudyPlan, people: int, habits: Habits, seed: int) -> list[dict[str, object]]:
    """Returns a row for each simulated participant who finished: condition and measures."""
    at_work, rows = Study.of(plan), []
    for condition in CONDITIONS:
        for number in range(people * len(plan.true_labels)):
            # The same people under both conditions.
            rng = stream(seed, "others", number)
            person = StudyBot(plan, habits, rng)
            end = take_part(at_work, person, 0, condition)
            if end.score is not None:
                rows.append(
                    {
                        "condition": condition,
                        "seconds": person.seconds,
                        "inexplicable": end.labels.count(0),
                        "score": end.score,
                        "messages": end.given.bit_count(),
                        "questions": len(end.asked),
                    }
                )
    return rows


def one(domain: str, seed: int, people: int) -> list[dict[str, object]]:
    """Returns the rows of one seed, with ``ari`` and the number of types; no rows if no study can
    be made."""
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()):
            types, ari = found_types(collection(domain, seed), Path(folder), seed)
        try:
            plan = study(domain, types, seed)
        except InputError as error:
            print(f"seed {seed}: ARI {ari:.2f}, no study: {error}", flush=True)
            return []
    rows = []
    for name, habits in HABITS.items():
        about = {"seed": seed, "ari": ari, "types": len(plan.problem.type_names), "people": name}
        rows += [about | row for row in took_part(plan, people, habits, seed)]
    return rows


def main() -> None:
    """Prints a row for each seed and condition, and the differences."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", default="rescue")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--people", type=int, default=20, help="per type and condition")
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    if given.quick:
        given.seeds, given.people = 1, 2
    seeds = range(given.first, given.first + given.seeds)
    rows = [row for seed in seeds for row in one(given.domain, seed, given.people)]
    if not rows:
        return
    everything = pd.DataFrame(rows)
    for name, data in everything.groupby("people", sort=False):
        each = data.groupby(["seed", "ari", "types", "condition"])[MEASURES].mean().round(2)
        print(f"\n{given.domain}, {name}\n{each.to_string()}")
        means = data.groupby(["seed", "condition"])[MEASURES].mean().unstack("condition")
        for measure in MEASURES:
            own = means[measure]["personalized"] - means[measure]["conformant"]
            found = clustered_mean(own, own.index)
            half = found.high - found.mean
            print(f"personalized − conformant, {measure}: {found.mean:.2f} ± {half:.2f}")


if __name__ == "__main__":
    main()
