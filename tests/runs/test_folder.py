"""The folder of a sweep: its lock, and the states in its files."""

import logging
import threading
from pathlib import Path

import pytest

from tests.report import handmade
from tests.runs.sweeps import planned
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.experiment.results import save_results
from xplain.runs.folder import alone, find_unlisted_results


def test_one_at_a_time_has_a_sweep_also_before_its_folder_is_there(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    folder = tmp_path / "sweeps" / "new-1"
    order = []

    def second() -> None:
        with alone(folder, "another process has it"):
            order.append("second")

    with alone(folder, "nobody has it"):
        waiting = threading.Thread(target=second)
        waiting.start()
        while (
            not any("another process has it" in said for said in caplog.messages)
            and waiting.is_alive()
        ):
            waiting.join(0.05)
        order.append("first")
    waiting.join()
    assert order == ["first", "second"]
    assert "nobody has it" not in caplog.text


def result_at(folder: Path, fingerprint: str) -> None:
    """Writes a result, and nothing else."""
    folder.mkdir(parents=True)
    save_results(folder, handmade.results(fingerprint, {}, ()))


def test_a_sweep_on_another_disk_finds_its_results(tmp_path: Path) -> None:
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    (tmp_path / "disk" / "deep").mkdir(parents=True)
    (outputs / "sweeps").symlink_to(tmp_path / "disk" / "deep")
    folder = planned(outputs, 1)
    result_at(outputs / "results" / "f0", "f0")
    assert [folder.state(job) for job in folder.jobs] == ["finished"]


def test_results_that_no_run_and_no_sweep_has_are_listed_and_deleted_when_told(
    tmp_path: Path,
) -> None:
    outputs = tmp_path / "outputs"
    folder = planned(outputs, 2)
    by_another_sweeper = folder.path.with_name("basic") / "jobs" / "f7"
    by_another_sweeper.mkdir(parents=True)
    for name in ("f0", "f1", "f7", "run", "lost", "old"):
        result_at(outputs / "results" / name, name)
    result_at(outputs / "runs" / "mine", "run")
    assert {path.name for path in find_unlisted_results(outputs)} == {"lost", "old"}
    assert all(size > 0 for size in find_unlisted_results(outputs).values())
    main(["clean", "--outputs", str(outputs)])
    assert len([*(outputs / "results").iterdir()]) == 6
    main(["clean", "--outputs", str(outputs), "--delete"])
    left = {path.name for path in (outputs / "results").iterdir()}
    assert left == {"f0", "f1", "f7", "run"}
    (folder.path / "sweep.json").write_text("not JSON")  # whose results are they?
    with pytest.raises(InputError):
        find_unlisted_results(outputs)
