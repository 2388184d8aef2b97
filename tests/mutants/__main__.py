"""``python -m tests.mutants --sample 60 --seed 1``: a sample of mutants, and who survived."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from tests.mutants.areas import Areas
from tests.mutants.campaign import Campaign, Interrupted, Session
from tests.mutants.report import equivalents, report
from tests.mutants.scratch import SURVIVED

ROOT = Path(__file__).parents[2]


def main(arguments: list[str]) -> int:
    """Runs or goes on with a campaign; 130 where it was interrupted."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--sample", type=int, default=60, help="mutants in all (60)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (1)")
    parser.add_argument("--jobs", type=int, default=1, help="tried at a time (1)")
    parser.add_argument("--areas", nargs="+", default=[], help="only these of areas.toml")
    parser.add_argument("--session", type=Path, help="file (outputs/mutants/seed-SEED.jsonl)")
    parser.add_argument("--again", action="store_true", help="survivors are tried once more")
    parser.add_argument("--report", action="store_true", help="tells what is known, runs nothing")
    given = parser.parse_args(arguments)
    for number in (signal.SIGTERM, signal.SIGINT):  # a shell's background job ignores the latter
        signal.signal(number, signal.default_int_handler)

    areas = Areas.load(ROOT)
    session = Session(given.session or ROOT / f"outputs/mutants/seed-{given.seed}.jsonl")
    campaign = Campaign(areas, session, say=lambda line: print(line, flush=True))
    drawn = areas.draw(given.sample, given.seed, given.areas)
    explained = equivalents(Path(__file__).with_name("equivalent.toml"))
    known = session.outcomes()
    pending = [mutant for mutant in drawn if mutant.key not in known]
    if given.again:
        pending += [
            mutant
            for mutant in drawn
            if mutant.key in known
            and known[mutant.key].outcome == SURVIVED
            and not any(one.is_(mutant, ROOT) for one in explained)
        ]
    interrupted = False
    if not given.report:
        print(f"{len(drawn)} mutants, {len(pending)} to be tried; {session.path}", flush=True)
        try:
            campaign.run(pending, given.jobs)
        except (KeyboardInterrupt, Interrupted):
            interrupted = True
    known = session.outcomes()
    found = [known[mutant.key] for mutant in drawn if mutant.key in known]
    print(report(found, explained, ROOT))
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
