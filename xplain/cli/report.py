"""Tables, plots and a page of a sweep: ``xplain report [SWEEP FOLDER] [measure=NAME]``.

Without a folder, the newest sweep below ``outputs/``. Jobs are compared by their ``regret`` where
all of them share an oracle, else by ``above_floor``, the cost above the clairvoyant's;
``measure=cost``, ``regret`` or ``above_floor`` compares by that.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from xplain.errors import InputError


def main(arguments: list[str]) -> None:
    """Writes the report anew, prints its table and the paths of its files."""
    given = [word for word in arguments if word.startswith("measure=")]
    folder = _folder([word for word in arguments if word not in given])
    from xplain.report.console import print_sweep
    from xplain.report.write import write_report

    summary, report = write_report(folder, given[-1].partition("=")[2] if given else None)
    if not summary.results:
        raise InputError("folder", str(folder), "a sweep with finished jobs")
    print_sweep(summary)
    for path in sorted(report.iterdir()):
        print(path)


def _folder(arguments: list[str]) -> Path:
    if len(arguments) > 1 or any(word.startswith("-") for word in arguments):
        raise InputError(
            "folder", " ".join(arguments), "xplain report [SWEEP FOLDER] [measure=NAME]"
        )
    from xplain.report.summary import load_sweep

    if arguments:
        folder = Path(arguments[0])
        if not (folder / "sweep.json").exists():
            raise InputError("folder", arguments[0], "a sweep's folder, below outputs/sweeps")
        return folder
    found = sorted(Path("outputs/sweeps").glob("*/sweep.json"), key=lambda p: -p.stat().st_mtime)
    for path in found:
        with suppress(InputError):  # a damaged one hides no other
            load_sweep(path.parent)
            return path.parent
    raise InputError("folder", "outputs/sweeps", "no sweep there; name a sweep's folder")
