"""The commands that the study and a collection share. Each function is the command of both: its
argument ``name`` is study or collect. The function's docstring is the command's help, in which this
word replaces NAME."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click
import yaml
from omegaconf import DictConfig, OmegaConf

from xplain.cli.commands import FILE, Decorator, command, keys
from xplain.errors import InputError, XplainError, first_line, mapping, one_of, whole_number
from xplain.experiment.config import compose_config

if TYPE_CHECKING:
    from xplain.people.flow import Flow
    from xplain.people.site import Server


def flow(name: str) -> type[Flow[Any, Any]]:
    """Imports the class with the stages of a study or a collection."""
    return import_module(f"xplain.people.{name}").FLOW


def _register_both(
    name: str, study: str, collect: str = "", config: bool = False, **settings: Any
) -> Decorator:
    """Registers a function twice: as a command of the study, and as a command of a collection.

    Args:
        name: name of the command after ``study`` or ``collect``; "" for the commands that serve
            pages.
        study: description of the study's command in one line.
        collect: description of the collection's command; "" for the same description.
        config: True if the commands show the files conf/study.yaml and conf/collect.yaml in their
            help.
        settings: settings of click's parser.
    """

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        for of, meaning in (("collect", collect or study), ("study", study)):
            command(f"{of} {name}".strip(), meaning, of if config else "", of, **settings)(function)
        return function

    return register


@_register_both("", "serve the user study", "collect labels from people", config=True)
@keys
def serve(name: str, words: list[str]) -> None:
    """Serves the user study, or pages on which people give labels, until it is stopped:
    ``xplain NAME port=8080``; for your own robot with ``transitions=TABLE.csv facts=FACTS.csv``.

    The first start stores the plan in the database; later starts continue with it. Only one process
    may have the database open. Instructions for a lab: docs/study.md, docs/collect.md.
    """
    from xplain.people.site import LOOPBACK

    cfg = load_config(name, words)
    # Before the plan is made, so that a wrong key is refused at once.
    server, path = server_of(cfg), database_of(cfg)
    kind = flow(name)
    made = kind.of(load_plan(name, cfg, path, kind))
    outside = server.address and urlsplit(server.address).hostname not in LOOPBACK
    if made.plan.unedited and outside and not server.demo:
        wanted = "demo for a pilot; else fill in [EDIT: …] in wording.consent, wording.introduction"
        raise InputError("consent", cfg.consent, wanted)
    print(made.announcement(), end="", file=sys.stderr)
    run_server(made, name, server, path, cfg)


def load_config(name: str, arguments: list[str]) -> DictConfig:
    """Composes the configuration. With a table of your own transitions, the configuration has no
    texts of a domain, and ``domain=null`` is allowed.

    Raises:
        InputError: both a domain and a table are given, or neither.
    """
    given = [one for one in arguments if one != "domain=null"]
    cfg = compose_config(name, given)
    if cfg.get("transitions") is None:
        if given != arguments:
            raise InputError("domain", None, "a domain; null only with transitions=TABLE")
        return cfg
    for one in given:
        if one.startswith("domain="):
            raise InputError("domain", one.removeprefix("domain="), "null with transitions=TABLE")
    return compose_config(name, [*given, f"{name}@wording=neutral"])


def database_of(cfg: DictConfig) -> Path:
    """Returns the database's path, and creates its folder.

    Raises:
        InputError: the folder cannot be written to.
    """
    path = Path(cfg.database).absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path.parent, os.W_OK):
        raise InputError("database", str(path), "a file in a folder that can be written to")
    return path


def server_of(cfg: DictConfig) -> Server:
    """Makes the settings of the server: keys of ``server``, and keys in the file ``server.file``.

    Raises:
        InputError: a key or value is not allowed.
    """
    from xplain.people.plan import make_typed
    from xplain.people.site import Server

    whole_number("port", cfg.port, 1, 65535)
    given: Any = OmegaConf.to_container(cfg.server, resolve=True)
    file = given.pop("file")
    try:
        own = yaml.safe_load(Path(file).read_text(encoding="utf-8")) if file else {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError("server.file", file, f"a YAML file ({first_line(error)})") from None
    given["demo"] = one_of("consent", cfg.consent, ("own", "demo")) == "demo"
    return make_typed(Server, "server", given | mapping("server.file", own, "keys of server"))


def load_plan(name: str, cfg: DictConfig, path: Path, kind: type[Flow[Any, Any]]) -> Any:
    """Returns the plan in the database. Makes a new plan if there is none.

    If a plan is stored, its configuration is used. Prints the names of the keys that have other
    values in ``cfg``, which are ignored.
    """
    from xplain.people.log import read_plan
    from xplain.people.material import select_plan_keys

    plan = read_plan(path, kind.PLAN)
    if plan is None:
        print(f"{name}: preparing {kind.PLAN.OF} …", file=sys.stderr)
        prepare = import_module(f"xplain.people.{name}.prepare")
        return getattr(prepare, f"{name}_plan")(cfg)
    now = select_plan_keys(cfg)
    if now["seed"] is None:
        del now["seed"]  # drawn once, at the first start
    ignored = [key for key in now if now[key] != plan.config.get(key)]
    if ignored:
        print(
            f"{name}: continues with the stored plan; these keys differ from it and are ignored: "
            f"{', '.join(ignored)}",
            file=sys.stderr,
        )
    return plan


def run_server(
    flow: Flow[Any, Any], name: str, server: Server, path: Path, cfg: DictConfig
) -> None:
    """Serves pages until the server is stopped."""
    import uvicorn

    from xplain.people.store import Store
    from xplain.people.web import create_app

    if "platform" in server.entry and not server.ids:
        print(
            f"{name}: anybody can invent an id in a platform's link and take a place; "
            "server.entry=[signed] or server.ids=FILE prevents this",
            file=sys.stderr,
        )
    host = f"[{cfg.host}]" if ":" in cfg.host else cfg.host
    with closing(Store(path, flow)) as store:
        key = "as set in server.key" if server.key else store.researcher_key
        print(
            f"{name}: {server.address or f'http://{host}:{cfg.port}'}/  ·  researcher's page: "
            f"/researcher, key {key}\n"
            f"{name}: database {path}, plan {flow.plan.hash[:16]}",
            file=sys.stderr,
            flush=True,
        )
        settings: Any = {"log_level": "warning", "server_header": False}
        settings |= {"timeout_keep_alive": 30, "timeout_graceful_shutdown": 5}
        uvicorn.run(create_app(store, server), host=cfg.host, port=cfg.port, **settings)


@_register_both(
    "bots",
    "let simulated participants take part",
    "let simulated people give labels",
    ignore_unknown_options=True,
)
@click.option("--url", default="http://127.0.0.1:8080")
@click.option("--key", envvar="XPLAIN_KEY", required=True)
@click.option("--count", type=click.IntRange(1, 10_000), default=40)
@click.option("--at-once", type=click.IntRange(1, 10_000), default=8)
@click.option("--pace", default=0.0)
@click.option("--seed", default=0)
@click.option("--save", type=FILE)
@click.argument("flags", nargs=-1, type=click.UNPROCESSED)
def bots(
    name: str,
    url: str,
    key: str,
    count: int,
    at_once: int,
    pace: float,
    seed: int,
    save: Path | None,
    flags: tuple[str, ...],
) -> None:
    """Lets simulated people take part on a server, over HTTP. Their data is always marked as data
    of bots, and is never mixed with people's data. Bots take no places of people.

        xplain NAME bots --key KEY [--url http://127.0.0.1:8080] [--count 40] [--at-once 8]
            [--pace 0] [--leaving 0] [--seed 0] [--save FILE]

    ``--key``: the researcher's key, which the server prints. The variable XPLAIN_KEY is safer,
    because any user of the machine can see a command line; ``--pace``: 1 is real time;
    ``--leaving``: probability of leaving at each page; ``--save``: file for the export (ZIP) at the
    end. Every habit is a flag. Habits of a study are in ``xplain.people.study.bot.Habits``, such as
    ``--label-noise 0.1``. Habits of a collection are in ``xplain.people.collect.bot.Habits``, such
    as ``--error 0.05`` (share of wrong answers) and ``--lapse 0`` (share of pages that are answered
    without reading).
    """
    from xplain.people.bots import Refusal, Researcher, crowd

    own = import_module(f"xplain.people.{name}.bot")
    options = [
        click.Option([f"--{one.name.replace('_', '-')}"], default=one.default)
        for one in fields(own.Habits)
    ]
    given = click.Command("bots", params=list[click.Parameter](options))
    habits = own.Habits(**given.make_context(f"xplain {name} bots", [*flags]).params)
    try:
        researcher = Researcher(url, key)
        person = partial(own.bot, researcher.plan(flow(name).PLAN), habits, seed)
        stages = crowd(researcher, count, at_once, pace, person)
        archive = researcher.archive() if save else b""
    except OSError as error:
        raise XplainError(f"--url={url}: the server does not answer ({error})") from None
    except Refusal as error:
        status, stage = error.args
        raise XplainError(f"--url={url}: status {status} for a bot on the page {stage}") from None
    if save:
        save.write_bytes(archive)
    print(", ".join(f"{number} {stage}" for stage, number in stages.most_common()))


@_register_both("export", "export the data as tables", "export the labels as tables")
@click.argument("database", type=FILE)
@click.argument("folder", type=FILE)
@click.option("--identifiers", type=FILE)
def export(name: str, database: Path, folder: Path, identifiers: Path | None) -> None:
    """Exports the data as tables (CSV and Parquet) with their codebook, from a snapshot or a
    database that no server has open. A collection also exports the table of labels that ``xplain
    discover`` reads.

        xplain NAME export DATABASE FOLDER [--identifiers FILE]

    ``--identifiers`` writes a separate file with completion codes, and the platform's ids if the
    server keeps them.
    """
    from xplain.people.export import write_identifiers
    from xplain.people.log import read

    digest = import_module(f"xplain.people.{name}.tables").export(database, folder)
    if identifiers:
        kind = flow(name)
        write_identifiers(read(database, kind.PLAN, kind.STATE)[1], identifiers)
    print(f"tables and codebook in {folder}\nSHA-256 of events.csv: {digest}")


@_register_both("backup", "copy the database, even in use")
@click.argument("database", type=FILE)
@click.argument("file", type=FILE)
def backup(name: str, database: Path, file: Path) -> None:
    """Copies a database into a new file, and its key into a file beside it. The server may run.

        xplain NAME backup DATABASE FILE

    To restore the database, replace the old files by these two files while no server runs.
    """
    from xplain.people.log import backup as copy

    copy(database, file)
    print(f"backup in {file}, its key in {file}.key: keep both secret")


@_register_both("erase", "erase a participant's data")
@click.argument("database", type=FILE)
@click.argument("reference")
def erase(name: str, database: Path, reference: str) -> None:
    """Erases the data of one participant, by the reference on their last page.

        xplain NAME erase DATABASE REFERENCE

    No server may have the database open. The researcher's page of a running server can do the
    same. The erasure is an event. Earlier exports and backups keep the data.

    In a collection, the priors of later participants depend on earlier answers. These priors stay
    in the log, without answers or reference.
    """
    if not database.is_file():
        raise InputError("database", str(database), flow(name).PLAN.OF + "'s database")
    from xplain.people.store import Store

    with closing(Store(database)) as opened:
        opened.erase_by(reference)
    print(f"erased {reference}; delete exports and backups that were made before, too")


@_register_both("replay", "compute all decisions again from the log")
@click.argument("database", type=FILE)
def replay(name: str, database: Path) -> None:
    """Computes all decisions again from the plan and the log, and checks that they are equal to the
    decisions in the log: beliefs and messages of a study, questions and posteriors of a collection.

        xplain NAME replay DATABASE

    No server may have the database open. The exit code is 1 if anything differs.
    """
    from xplain.people.export import find_differences
    from xplain.people.log import read

    kind = flow(name)
    plan, people = read(database, kind.PLAN, kind.STATE)
    differences = find_differences(kind.of(plan), people)
    for difference in differences:
        print(difference, file=sys.stderr)
    verdict = f"{len(differences)} differences" if differences else "all equal"
    print(f"{len(people)} participants replayed: {verdict}")
    if differences:
        sys.exit(1)


@command("collect habits", "how people listened and answered")
@click.argument("database", type=FILE)
@click.option("--stream", default="person")
def habits(database: Path, stream: str) -> None:
    """Learns from the log how often people err, accept messages and forget them. Prints the rates
    as keys for a study or an experiment.

        xplain collect habits DATABASE [--stream person]

    No server may have the database open (a snapshot also works); ``--stream`` is person, pilot or
    bot. The collection must be started with ``rules.listening``; its rate of forgetting is per
    page.
    """
    from xplain.explanation.listening import learn_habits
    from xplain.people.collect.tables import listeners_in

    listeners = listeners_in(database, stream)
    found = learn_habits(listeners)
    print(f"{len(listeners)} participants: rates, and how many people have them")
    for key in ("error", "accept", "forget"):
        shares = found.shares(key)
        mean = sum(rate * share for rate, share in shares.items())
        written = ",".join(f"{rate:g}:{share:.3f}" for rate, share in shares.items())
        print(f"belief.{key}={{{written}}}   mean {mean:.3f}")


@command("study preregister", "write the plan as a document to register")
@click.argument("database", type=FILE)
@click.option("--out", type=FILE)
def preregister(database: Path, out: Path | None) -> None:
    """Writes a document to register before the first participant, from the plan: hypotheses,
    design, measures, exclusions, analysis and sample size.

        xplain study preregister DATABASE [--out FILE]

    DATABASE belongs to a study that was started at least once, so the registered plan is the plan
    that runs.
    """
    from xplain.people.log import read_plan
    from xplain.people.study.analysis import document
    from xplain.people.study.plan import StudyPlan

    plan = read_plan(database, StudyPlan)
    if plan is None:
        raise InputError("database", str(database), "the database of a study that was started")
    text = document(plan)
    if out is None:
        print(text, end="")
        return
    out.write_text(text, encoding="utf-8")
    print(f"preregistration in {out}")


@command("study analyse", "compute the paper's Table 2 from the data")
@click.argument("folder", type=FILE)
@click.option("--stream", default="person")
@click.option("--exclude", type=FILE)
@click.option("--seed", default=0)
@click.option("--out", type=FILE)
def analyse(folder: Path, stream: str, exclude: Path | None, seed: int, out: Path | None) -> None:
    """Computes the paper's Table 2 from an export of the study, with plots. A condition with
    questions is also compared with the personalized condition.

        xplain study analyse FOLDER [--stream person] [--exclude FILE] [--seed 0] [--out FOLDER]

    FOLDER contains participants.csv, as exported. ``--stream`` is person, pilot or bot;
    ``--exclude`` is a CSV file with the columns participant and reason; ``--seed`` is the seed of
    the permutation tests.
    """
    from rich.console import Console

    from xplain.people.study.analysis import analyse_all, exclusions, read, save, show

    found = analyse_all(read(folder), stream, exclusions(exclude), seed=seed)
    out = out or folder
    files: list[str] = []
    for name, analysis in found.items():
        files += save(analysis, out, name)
        show(analysis, Console(width=None if Console().is_terminal else 150))
    print(f"{', '.join(dict.fromkeys(files))} in {out}")
