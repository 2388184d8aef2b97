"""Measures the properties that make the domains real tasks, and draws rescue's map
(docs/domains.md).

    python benchmarks/domains.py            the table of properties, in Markdown
    python benchmarks/domains.py --draw     draws random maps up to the first with all properties
    python benchmarks/domains.py --pictures a trace on each of the paper's domains (docs/pictures)
    python benchmarks/domains.py --quick    a smoke run

No learner and no solver of explanations is involved: only the tasks, their types, and true labels.
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from omegaconf import OmegaConf

sys.path.insert(0, str(Path(__file__).parent.parent))

from rescue_maps import random_map

from tests.domains.properties import (
    Trace,
    count_traces,
    inexplicable_alone,
    on_policy_traces,
    problems,
    share_through,
)
from xplain.domains.four_rooms import DOORS
from xplain.domains.rescue import Rescue
from xplain.domains.users.setting import Setting
from xplain.errors import XplainError
from xplain.experiment.config import compose_config
from xplain.randomness import stream
from xplain.report.plots import save
from xplain.report.trace import draw_trace

DOMAINS = ("four_rooms", "rescue", "taxi", "cliff_walking", "frozen_lake")
PICTURES = Path(__file__).parent.parent / "docs" / "pictures"
TYPE_COUNTS = (2, 3, 4)
"""Numbers of types, for domains with random types: figures are means over these and the seeds."""
SEEDS = 10
TRACES = 200


def settings_of(domain: str, seeds: int = SEEDS) -> list[Setting]:
    """Returns the domain with its types; for random types one setting for each count and seed."""
    cfg = compose_config("observe", [f"domain={domain}"])
    made = instantiate(cfg.domain)
    if "count" not in cfg.users:
        return [Setting.build(made, instantiate(cfg.users).types(made, stream(0, "users")))]
    return [
        Setting.build(made, instantiate(cfg.users, count=n).types(made, stream(seed, "users")))
        for n, seed in product(TYPE_COUNTS, range(seeds))
    ]


def sampled(setting: Setting) -> list[Trace]:
    """Draws the traces on which the figures are measured."""
    return on_policy_traces(setting, TRACES, stream(0, "domain properties"))


def properties(domain: str, seeds: int = SEEDS) -> dict[str, str]:
    """Returns the figures of a domain, a column of the table."""
    settings = settings_of(domain, seeds)
    first = settings[0]
    number, traces = count_traces(first), sampled(first)
    found = [problems(setting, traces) for setting in settings]
    alone = inexplicable_alone(first.domain, traces)
    through = f"{share_through(first.domain, traces, DOORS):.0%}"

    def mean(values: Iterator[Any]) -> float:
        return float(np.mean([np.mean(value) for value in values]))

    return {
        "starts": str(len(first.domain.starts)),
        "transitions the robot may make": str(len(first.reachable)),
        "different traces": f"{number:,}" if number < 1_000_000 else "over a million",
        "mean length of a trace": f"{np.mean([len(trace) for trace in traces]):.1f}",
        "traces through a door": through if domain == "four_rooms" else "–",
        "share of transitions that one incorrect fact makes inexplicable (least, most)": (
            f"{min(alone.values()):.0%}, {max(alone.values()):.0%}"
        ),
        "mean smallest explaining set": f"{mean(p.smallest for p in found):.2f}",
        "(trace, type) that need no message": f"{mean(p.smallest == 0 for p in found):.0%}",
        "(trace, type) where the set costs less than silence, λ ≤ 2.5": (
            f"{mean(p.worth for p in found):.0%}"
        ),
        "different label tables": f"{mean(p.tables for p in found):.0f}",
        "traces with the most frequent label table": f"{mean(p.commonest for p in found):.0%}",
        "traces with a transition that puzzles every type": (
            f"{mean(p.puzzling for p in found):.0%}"
        ),
    }


def has_all(setting: Setting) -> bool:
    """Returns True if a rescue task has the required properties of its map (docs/choices.md)."""
    traces = sampled(setting)
    found = problems(setting, traces)
    return bool(
        1.5 <= found.smallest.mean() <= 2.0
        and found.worth.mean() >= 0.95
        and found.tables >= 15
        and found.commonest <= 0.25
        and found.puzzling <= 0.1
        and min(inexplicable_alone(setting.domain, traces).values()) >= 0.02
    )


def draws() -> Iterator[tuple[str, bool | None]]:
    """Yields random maps, with True if they have all properties; None if an object has no way to
    the shelter."""
    cfg = compose_config("observe", ["domain=rescue"])
    node: Any = OmegaConf.to_container(cfg.domain, resolve=True)
    fixed = {key: value for key, value in node.items() if not key.startswith("_")}
    source = instantiate(cfg.users)
    rng = stream(0, "rescue maps")
    while True:
        drawn = random_map(rng)
        try:
            domain = Rescue(**fixed | {"map": drawn})
            setting = Setting.build(domain, source.types(domain, stream(0, "users")))
        except XplainError:
            yield drawn, None
            continue
        yield drawn, has_all(setting)


def draw(most: int) -> None:
    """Prints the first map with all properties, and the number of maps drawn."""
    usable = 0
    for number, (drawn, chosen) in enumerate(islice(draws(), most), 1):
        usable += chosen is not None
        if chosen:
            print(f"map {number} of seed 0 ({usable} of these maps can be used):\n{drawn}", end="")
            return
    print(f"none of {most} maps ({usable} can be used) has all properties")


def picture(domain: str, folder: Path) -> None:
    """Draws the sampled trace through the most doors (in rescue: the longest), labelled by a user
    of the first type without messages."""
    setting = settings_of(domain, 1)[0]
    traces = sampled(setting)

    def doors(trace: Trace) -> tuple[float, int]:
        return sum(share_through(setting.domain, [trace], [door]) for door in DOORS), len(trace)

    number = max(range(len(traces)), key=lambda index: doors(traces[index]))
    trace = traces[number]
    labels = setting.label_table(trace)[0, :, 0].tolist()
    steps = [{"messages": [], "labels": labels[: k + 1]} for k in range(len(trace))]
    places = [setting.domain.position(int(s)) for s in (*trace[:, 0], trace[-1, 2])]
    kind = f"{setting.types[0].name} ({', '.join(setting.types[0].inaccurate)})"
    story = {
        "type": kind,
        "transitions": [setting.domain.describe(step) for step in trace],
        "positions": [place for place in places if place is not None],
        "steps": steps,
    }
    caption = f"{kind}, without messages"
    save(draw_trace(setting.domain.scene, story, caption, {}), folder / f"{domain}.png")


def main() -> None:
    """Prints the table, or draws the map."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draw", action="store_true", help="draw rescue's map again")
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--pictures", action="store_true", help="draw the pictures again")
    options = parser.parse_args()
    if options.draw:
        draw(20 if options.quick else 20_000)
        return
    if options.pictures:
        for name in DOMAINS[:2]:
            picture(name, PICTURES)
        return
    names = DOMAINS[:2] if options.quick else DOMAINS
    columns = [properties(name, 1 if options.quick else SEEDS) for name in names]
    print(f"| | {' | '.join(names)} |")
    print("|---" * (len(names) + 1) + "|")
    for key in columns[0]:
        print(f"| {key} | {' | '.join(column[key] for column in columns)} |")


if __name__ == "__main__":
    main()
