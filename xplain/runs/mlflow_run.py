"""What a run or a sweep's parent holds in MLflow: what people compare; all else is in its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from xplain.experiment.results import Results
from xplain.runs.plan import Job

if TYPE_CHECKING:
    from mlflow import MlflowClient

FIGURES = (
    "regret",
    "cost",
    "oracle_cost",
    "messages",
    "inexplicable_labels",
    "steps_until_sure",
    "decision_ms",
)
"""Of a result's figures, those that are compared; ``results.json`` among the files has all."""

LEARNED = ("types_found", "adjusted_rand_index", "labeler_accuracy")
MOST_PARAMETERS = 25


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
    metrics = [Metric(name, round(value, 4), end, step) for name, value in scalars(results).items()]
    for index, value in enumerate(results.steps.get("belief_in_true_type", ())):
        metrics.append(Metric("belief_in_true_type", value, end, index))
    for k, value in enumerate(results.elbow.disagreements, start=1):
        metrics.append(Metric("disagreements", value, end, k))
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
    """Figures that make one number each: at most 13, two curves besides."""
    flat = {name: results.metrics[name].mean for name in FIGURES if name in results.metrics}
    if "regret" in results.metrics:
        regret = results.metrics["regret"]
        for end, value in (("low", regret.low), ("high", regret.high)):
            if value is not None:
                flat[f"regret.{end}"] = value
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


def parent_parameters(jobs: Sequence[Job]) -> dict[str, str]:
    """Of a sweep's parent: what was swept, with all values, and the number of jobs."""
    values: dict[str, dict[str, None]] = {}
    for job in jobs:
        for key, value in job.values.items():
            values.setdefault(key, {})[value] = None
    found = {key: ", ".join(own)[:500] for key, own in list(values.items())[: MOST_PARAMETERS - 1]}
    return found | {"jobs": str(len(jobs))}
