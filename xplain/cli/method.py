"""The commands around the experiment. Each calls a function that Python code can also call."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from xplain.cli.commands import FILE, command, keys
from xplain.errors import InputError

if TYPE_CHECKING:
    from xplain.runs.mlflow import MLflow

log = logging.getLogger(__name__)


@command("discover", "find the user types in a table of labels", "discover")
@keys
def discover(words: list[str]) -> dict[str, Any]:
    """Finds the user types in people's labels: ``xplain discover data=FILE``.

    :mod:`xplain.learning.data.label_file` describes this file. The folder ``output`` receives

    - ``types.npz``: the types and their labelers, as :class:`xplain.learning.saved.LearnedTypes`
      loads them (for ``xplain.Explainer``);
    - ``assignment.csv``: the type of each observer;
    - ``predictions.csv``, with ``predict=FILE``: the rows of FILE, and ``p``, the probability that
      the observer answers 1;
    - ``summary.json``: the figures of each type, and the method that found it;
    - ``curve.png`` (disagreements by number of types) or ``posterior.png`` (probability of each
      number of types), depending on the method; ``messages.png``: the effect of each message on
      each type; ``calibration.png``: the predicted probability of label 1 against the share of
      labels 1, for held-out labels.

    The last line on standard output is one JSON object: ``n_types``, ``assignment`` {observer:
    type}, ``method``, ``rule``, ``held_out`` (mean log-likelihoods of held-out labels in nats per
    label, if they are predicted with types and without types; null if ``held_out=false``),
    ``held_out_log_likelihood`` (only the figure with types), ``seconds``; if it can be estimated,
    also ``accept`` {message: [probability that it is accepted, lower and upper end of its 95 %
    interval]}.
    """
    from xplain.experiment.config import compose_config
    from xplain.runs.labels import discovery

    cfg = compose_config("discover", words)
    folder = Path(cfg.output)
    found = discovery(cfg, folder)
    found.show(folder)
    return found.row


@command("observe", "write labels of simulated observers", "observe")
@keys
def observe(words: list[str]) -> dict[str, Any]:
    """Writes labels of simulated observers: ``xplain observe domain=rescue output=FILE``.

    ``xplain discover`` reads this table. A second file has the observers' true types (columns
    ``observer``, ``type``, and ``behaves_like``, the first type with the same labels). The last
    line on standard output is one JSON object: ``output``, ``truth``, ``observers``, ``labels``,
    ``types``.
    """
    from xplain.experiment.config import compose_config
    from xplain.runs.labels import write_labels

    return write_labels(compose_config("observe", words, with_hydra=True))


@command("questions", "what to ask people, as a list", "questions")
@keys
def questions(words: list[str]) -> dict[str, Any]:
    """Lists questions to ask people: ``xplain questions domain=rescue output=questions.csv``.

    The answers separate all sets of facts that people might believe incorrectly. The command prints
    the questions, and writes them as a table: ``question``, ``transition`` (row in the hypotheses),
    ``text`` (what the robot does), ``image``, ``messages`` (names joined by ``;``), ``told`` (the
    sentences of these messages), and the features, if any. The last line on standard output is one
    JSON object: ``output``, ``questions``, ``transitions``, ``candidates`` (number of sets of facts
    that behave differently).
    """
    from rich.console import Console
    from rich.table import Table

    from xplain.experiment.config import compose_config
    from xplain.runs.labels import write_questions

    questions, about = write_questions(compose_config("questions", words, with_hydra=True))
    table = Table("", "the robot", "told before")
    for row in questions.to_dict("records"):
        table.add_row(str(row["question"]), row["text"], row["told"] or "nothing")
    Console().print(table)
    return about


@command("plan", "plan for a saved explanation problem", "plan")
@keys
def plan(words: list[str]) -> dict[str, Any] | list[dict[str, Any]]:
    """Plans for a saved problem: ``xplain plan problem=FILE.npz solver=NAME seed=0``.

    The last line on standard output is one JSON object:

    - ``solver``;
    - ``first_messages``: indices of the messages given before the first *explain*; null if they
      depend on a type that only the solver knows (oracle, clairvoyant);
    - if the problem has questions: ``first_question``, the question before these messages
      (``number`` and words), or null; ``question_values``, the policy's value of each question that
      it evaluated, best first. If a question comes first, ``first_messages`` depends on its answer
      and is null;
    - ``value``: expected discounted return of the executed policy under the model; for a solver
      that knows the type, Σ_t prior(t) V*_t, with V*_t the optimal value for users of type t;
    - ``value_is``: "exact", or "simulated" with its standard error ``value_se`` and half of its
      95 % interval, ``value_half_width``;
    - ``optimal_lower``, ``optimal_upper``: bounds of the optimal value; null if not computed;
    - ``seconds``: time to plan and to take the first decision.

    ``solver=all`` prints a comparison first, and the line is a list of such objects.
    """
    from xplain.cli.plan import compare_solvers, plan_problem
    from xplain.experiment.config import compose_config

    if "solver=all" in words:
        return compare_solvers([word for word in words if word != "solver=all"])
    return plan_problem(compose_config("plan", words, with_hydra=True))


@command("export", "write a saved problem for POMDP solvers", "export")
@keys
def export(words: list[str]) -> None:
    """Writes a saved problem for other programs:
    ``xplain export problem=FILE.npz format=pomdp output=FILE.pomdp``.
    """
    from xplain.experiment.config import compose_config
    from xplain.explanation.files import load, pomdp_lines
    from xplain.storage import open_atomic

    cfg = compose_config("export", words)
    if cfg.format != "pomdp":
        raise InputError("format", cfg.format, "pomdp")
    problem = load(cfg.problem)
    with open_atomic(Path(cfg.output)) as file:
        file.writelines(f"{line}\n" for line in pomdp_lines(problem))
    print(Path(cfg.output))


@command("report", "make the tables, plots and page of a sweep")
@click.argument("words", nargs=-1)
def report(words: tuple[str, ...]) -> None:
    """Writes tables, plots and a page of a sweep: ``xplain report [SWEEP FOLDER] [measure=NAME]``.

    The default is the newest sweep below ``outputs/``. Jobs are compared by their ``regret`` if all
    of them share an oracle, otherwise by ``above_floor``, the cost above the clairvoyant's;
    ``measure=cost``, ``regret`` or ``above_floor`` chooses another measure.
    """
    from xplain.report.page import write_report
    from xplain.report.terminal import print_sweep
    from xplain.runs.folder import newest_sweep

    measures = [word.partition("=")[2] for word in words if word.startswith("measure=")]
    folders = [word for word in words if not word.startswith("measure=")]
    if len(folders) > 1:
        wanted = "xplain report [SWEEP FOLDER] [measure=NAME]"
        raise InputError("folder", " ".join(folders), wanted)
    folder = Path(folders[0]) if folders else newest_sweep(Path("outputs"))
    if not (folder / "sweep.json").exists():
        raise InputError("folder", str(folder), "a sweep's folder, below outputs/sweeps")
    summary, written = write_report(folder, measures[-1] if measures else None)
    if not summary.results:
        raise InputError("folder", str(folder), "a sweep with finished jobs")
    print_sweep(summary)
    for path in sorted(written.iterdir()):
        print(path)


@command("sync", "send results on disk to MLflow")
@click.argument("words", nargs=-1)
def sync(words: tuple[str, ...]) -> None:
    """Sends results on disk to MLflow: ``xplain sync [FOLDER ...] [tracking.uri=URI]``.

    The default is every result below ``outputs/``. A sweep is a parent run with its jobs as
    children. Runs that are already in MLflow are not sent again; incomplete runs are completed.
    """
    from hydra.utils import instantiate

    from xplain.experiment.config import compose_config
    from xplain.runs.mlflow import sync as send

    # Names of folders may have an equals sign as well.
    folders = [Path(word) for word in words if Path(word).exists() or "=" not in word]
    given = [word for word in words if Path(word) not in folders]
    cfg = compose_config("config", ["tracking=mlflow", *given])
    tracking: MLflow = instantiate(cfg.tracking)
    count = send(folders or [Path(cfg.outputs)], Path(cfg.outputs), tracking)
    print(f"{count} results in MLflow")


@command("clean", "list results that no run or sweep has, or delete them")
@click.option("--delete", is_flag=True)
@click.option("--outputs", type=FILE, default="outputs")
def clean(delete: bool, outputs: Path) -> None:
    """Lists the results that belong to no run or sweep in the outputs folder, with their sizes.

        xplain clean [--outputs FOLDER]        lists them
        xplain clean --delete                  deletes them

    If you delete the folder of a run or a sweep, its results stay below ``results/``. A deleted
    result is computed again when it is needed.
    """
    from xplain.runs.folder import delete_result, find_unlisted_results

    sizes = find_unlisted_results(outputs)
    for folder, size in sizes.items():
        print(f"{size / 2**20:8.1f} MiB  {folder}")
        if delete:
            delete_result(folder)
    done = "deleted" if delete else "that no run or sweep has; xplain clean --delete deletes them"
    print(f"{len(sizes)} results, {sum(sizes.values()) / 2**20:.1f} MiB, {done}")


@command("serve", "serve explanations and questionnaires over HTTP, with a playground", "serve")
@keys
def serve(words: list[str]) -> None:
    """Serves the method over HTTP until it is stopped (docs/service.md): explanations and
    questionnaires, for pages and robots of your own, and a playground in the browser.
    """
    import uvicorn

    from xplain.experiment.config import compose_config
    from xplain.people.service.app import create_app
    from xplain.people.service.served import make_served
    from xplain.people.service.talks import Talks

    cfg = compose_config("serve", words)
    talks = Talks(Path(cfg.database), make_served(cfg))
    try:
        print(f"service: http://{cfg.host}:{cfg.port}/", file=sys.stderr)
        app = create_app(talks, tuple(cfg.origins), cfg.key)
        uvicorn.run(app, host=cfg.host, port=cfg.port, log_level="warning")
    finally:
        talks.close()


@command("demo", "play one explanation, with a simulated user")
@click.option("--user")
@click.option("--trace", type=click.IntRange(0))
@click.option("--html", type=FILE, default="demo.html")
@keys
def demo(words: list[str], user: str | None, trace: int | None, html: Path) -> None:
    """Plays one explanation, and writes it as a page that shows each step, also on phones. At each
    step the robot gives messages to the user, and the user says which transitions make no sense.

        xplain demo                              writes demo.html: an instructive user and trace
        xplain demo --user B lambda=2            a simulated user of type B
        xplain demo --trace 3                    another trace, from 0
        xplain demo --html mine.html             another file
        xplain demo domain=four_rooms solver=qhr seed=3

    By default five traces are tried. The page shows the trace in which the explainer finds the
    user's type with the fewest messages. Keys are the keys of the experiment (domain, users,
    solver, lambda, seed, ...).
    """
    if not html.absolute().parent.is_dir():
        raise InputError("--html", str(html), "a file in a folder that exists")
    from xplain.demo.page import write_page

    write_page(words, trace, user, html)
    print(html)
