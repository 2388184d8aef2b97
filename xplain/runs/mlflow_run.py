"""What a run or a sweep's parent holds in MLflow: what people compare; all else is in its files."""

from __future__ import annotations

import getpass
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from xplain.experiment.results import Results, load_results

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

RESULT_TAG = "xplain.result"
"""Tag that holds a result's identity; a result is in MLflow once, however often it is sent."""

PARENT_TAG = "mlflow.parentRunId"

FIGURES = {
    "regret": "regret",
    "regret_to_clairvoyant": "above_floor",
    "cost": "cost",
    "messages": "messages",
    "inexplicable_labels": "inexplicable_labels",
    "questions": "questions",
    "steps_until_sure": "steps_until_sure",
}
"""Of a result's figures, those that are compared, by their names in MLflow; ``results.json`` among
the files has all."""

LEARNED = ("adjusted_rand_index", "labeler_accuracy")
MOST_PARAMETERS = 25


@dataclass(frozen=True)
class RunStore:
    """Where runs go.

    Attributes:
        client: of MLflow.
        experiment: its id.
        pages: address of the user interface, up to the ``#``.
    """

    client: MlflowClient
    experiment: str
    pages: str = "#"

    def tagged(self, tag: str, value: str) -> Iterator[Run]:
        """Every run with this value of a tag, page after page."""
        token = None
        while True:
            page = self.client.search_runs(
                [self.experiment], f"tags.`{tag}` = '{value}'", max_results=500, page_token=token
            )
            yield from page
            token = page.token
            if not token:
                return

    def once(
        self, known: Iterable[Run], name: str, status: str, started: int, tags: dict[str, str]
    ) -> tuple[str, bool]:
        """The id of a run that is known with this status and start, else of a new one; and whether
        it is new. Other known ones are deleted: a sender died half-way, or they are of an earlier
        attempt."""
        kept = ""
        for run in known:
            if (run.info.status, run.info.start_time) == (status, started) and not kept:
                kept = str(run.info.run_id)
            else:
                self.client.delete_run(run.info.run_id)
        if kept:
            return kept, False
        created = self.client.create_run(self.experiment, started, tags, name)
        return str(created.info.run_id), True


def send_run(store: RunStore, folder: Path) -> str:
    """Sends the results of a run on its own; returns the id of its run in MLflow."""
    results = load_results(folder)
    known = store.tagged(RESULT_TAG, results.id)
    tags = {RESULT_TAG: results.id, **source_tags(results.git)}
    started = int(1000 * results.started)
    run_id, new = store.once(known, results.name, "FINISHED", started, tags)
    if new:
        fill(store.client, run_id, folder, results)
    return run_id


def source_tags(git: Mapping[str, str]) -> dict[str, str]:
    """Tags that tell who ran what; the client sets none of these by itself."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = "unknown"
    tags = {
        "mlflow.user": user,
        "mlflow.source.name": "python -m xplain",
        "mlflow.source.type": "LOCAL",
    }
    if git:
        tags |= {"mlflow.source.git.commit": git["commit"], "git.dirty": git["dirty"]}
    return tags


def fill(
    client: MlflowClient,
    run_id: str,
    folder: Path,
    results: Results,
    swept: Mapping[str, str] | None = None,
    step: int = 0,
) -> None:
    """Logs a result into its run and marks it finished; doing it twice changes nothing.

    What people compare are metrics and parameters; all else is in the files beside them.

    Args:
        client, run_id: where to.
        folder, results: of the finished run.
        swept: keys of the sweep with this run's values.
        step: where its figures stand in charts of the sweep.
    """
    from mlflow.entities import Metric, Param, RunTag

    end = ended(results)
    belief, disagreements = "belief_in_true_type", results.elbow.disagreements
    metrics = [
        *(Metric(name, round(own, 4), end, step) for name, own in scalars(results).items()),
        *(Metric(belief, own, end, k) for k, own in enumerate(results.steps.get(belief, ()))),
        *(Metric("disagreements", own, end, k) for k, own in enumerate(disagreements, start=1)),
    ]
    params = [Param(key, value) for key, value in parameters(results, swept or {}).items()]
    tags = {
        "xplain.code": results.code,
        "xplain.folder": str(folder),
        "xplain.rule": results.elbow.rule,
        "mlflow.note.content": _description(results),
    }
    client.log_batch(run_id, metrics, params, [RunTag(*tag) for tag in tags.items()])
    for path in sorted(folder.iterdir()):
        if path.is_file() and not path.name.startswith("."):
            client.log_artifact(run_id, str(path))
    client.set_terminated(run_id, "FINISHED", end)


def ended(results: Results) -> int:
    """When the work of a result was done, in milliseconds since 1970."""
    return int(1000 * (results.started + sum(results.seconds.values())))


def scalars(results: Results) -> dict[str, float]:
    """Figures that make one number each: at most 14, two curves besides."""
    known = {FIGURES[key]: own for key, own in results.metrics.items() if key in FIGURES}
    flat = {name: own.mean for name, own in known.items()}
    for name in {"regret", "above_floor"} & known.keys():
        ends = {f"{name}.low": known[name].low, f"{name}.high": known[name].high}
        flat |= {end: value for end, value in ends.items() if value is not None}
    flat |= {name: results.learning[name] for name in LEARNED if name in results.learning}
    return flat | {"seconds": sum(results.seconds.values())}


def parameters(results: Results, swept: Mapping[str, str]) -> dict[str, str]:
    """What was swept, the choices by group (``solver = pomcp``), and the experiment's own numbers
    and words; ``config.yaml`` among the files has all keys."""
    own = {key: value for key, value in results.config.items() if not isinstance(value, Mapping)}
    every = {**{key: swept[key] for key in swept if "." in key}, **results.choices, **own}
    return {key: str(value)[:500] for key, value in list(every.items())[:MOST_PARAMETERS]}


def _description(results: Results) -> str:
    """What a run is, for whoever meets it in a list."""
    text = (
        f"{results.domain}, explained by {results.solver} at λ = {results.trade_off:g} (seed "
        f"{results.seed}, {results.config.get('traces', '?')} traces)"
    )
    if "regret" in results.metrics:
        regret = results.metrics["regret"]
        text += f": regret {regret.mean:.3f}"
        if regret.low is not None:
            text += f", 95 % interval over traces {regret.low:.3f} … {regret.high:.3f}"
    return (
        f"{text}. Artifacts: `results.json` has all figures and the whole configuration, "
        "`episodes.jsonl` every step."
    )
