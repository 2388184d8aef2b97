"""Writes docs/config.md: every configuration key, from the comments in conf/*.yaml.

python docs/config_reference.py            writes it
python docs/config_reference.py --check    exit code 1 if it is out of date
"""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parent.parent
CONF, PAGE = ROOT / "conf", ROOT / "docs" / "config.md"

GROUPS = {
    "domain": "the robot's task",
    "users": "the true user types",
    "observers": "the people who label transitions",
    "queries": "what observers are asked",
    "labeler": "learns a labeling model from labels",
    "clusterer": "finds the user types",
    "solver": "plans the explanation",
    "belief": "which labels are evidence, and how users are assumed to answer",
    "explainee": "how simulated users listen and answer",
    "ask": "what the explainer asks the user",
    "tracking": "where results are sent besides the disk",
}
COMMANDS = ("discover", "observe", "questions", "plan", "export", "collect", "serve")
"""Commands with keys of their own."""
UNTOLD = ("defaults", "hydra", "_convert_", "_target_")
"""Sections that are no settings of an experiment."""
SENTENCES = ("message", "belief")
"""Fields of a domain's parameter with words for people; these, and everything below ``words``, are
no settings to explain."""

LINE = re.compile(r"^(?P<indent> *)(?P<key>[\w.]+):(?: (?P<rest>.*))?$")
COMMENT = re.compile(r"^(?P<value>(?:\"[^\"]*\"|'[^']*'|[^#])*?)(?:(?:^|\s+)# (?P<comment>.*))?$")


@dataclass(frozen=True)
class Key:
    """One line of a table."""

    path: str
    default: str
    meaning: str


def main() -> int:
    """Writes or checks the page."""
    text = page()
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(text, encoding="utf-8")
        return 0
    if PAGE.exists() and PAGE.read_text(encoding="utf-8") == text:
        return 0
    print("docs/config.md is out of date: python docs/config_reference.py", file=sys.stderr)
    return 1


def page() -> str:
    """Writes the whole page."""
    parts = [
        "# Configuration\n",
        "`python docs/config_reference.py` writes this page from the comments in `conf/`; "
        "edit these comments.\n",
        "Any key can be set on the command line (`python -m xplain lambda=2 solver=qhr`), "
        "`group=choice` selects another file; `+group=...` is never needed. "
        "`python -m xplain --cfg job` prints the configuration of a run. "
        "These commands have their own keys: "
        f"{', '.join(f'[{name}](#the-command-{name}-conf{name}yaml)' for name in COMMANDS)} and "
        "[study](#the-user-study-confstudyyaml).\n",
        "## The experiment (`conf/config.yaml`)\n",
        section(CONF / "config.yaml", ""),
    ]
    for group, what in GROUPS.items():
        files = sorted((CONF / group).glob("*.yaml"))
        parts.append(f"## {group}: {what}\n")
        for file in files:
            parts += [f"### `{group}={file.stem}`\n", section(file, f"{group}.")]
    for command in COMMANDS:
        parts.append(f"## The command `{command}` (`conf/{command}.yaml`)\n")
        parts.append(section(CONF / f"{command}.yaml", ""))
    parts += ["## The user study (`conf/study.yaml`)\n", section(CONF / "study.yaml", "")]
    parts += ["## The pages of both (`conf/pages.yaml`)\n", section(CONF / "pages.yaml", "")]
    return "\n".join(parts)


def section(file: Path, prefix: str) -> str:
    """Writes a section: the file's description, and its keys."""
    lines = file.read_text(encoding="utf-8").splitlines()
    whole = lines[0].startswith("# @package _global_")
    lines = lines[whole:]
    about = []
    while lines and lines[0].startswith("#"):
        about.append(lines.pop(0).removeprefix("#").removeprefix(" "))
    rows = list(keys(lines, "" if whole else prefix))
    made = re.search(r"^(?:  )?_target_: (xplain\S+)", "\n".join(lines), re.MULTILINE)
    if made:
        about.append(f"Class: `{made[1]}`.")
    if parent := parent_of(file):
        if prefix:
            about.append(f"All other keys are as in `{prefix[:-1]}={parent}`.")
        rows = [row for row in rows if row.meaning]
    table = "\n".join(
        ["| key | default | meaning |", "|---|---|---|"]
        + [f"| `{row.path}` | {code(row.default)} | {cell(row.meaning)} |" for row in rows]
    )
    return "\n".join([paragraph(about), table if rows else "No settings.", ""])


def parent_of(file: Path) -> str | None:
    """Finds the choice of the same group that a file changes; None if it changes none."""
    defaults = yaml.safe_load(file.read_text(encoding="utf-8")).get("defaults", [])
    return next((one for one in defaults if isinstance(one, str) and one != "_self_"), None)


def keys(lines: list[str], prefix: str) -> Iterator[Key]:
    """Yields the keys of a file, with their full paths."""
    path: list[tuple[int, str]] = []
    above: list[str] = []
    hidden = block = -1
    for line in lines:
        bare = line.strip()
        depth = len(line) - len(line.lstrip())
        if not bare:
            above = []
            continue
        if 0 <= block < depth or 0 <= hidden < depth:
            continue
        block = hidden = -1
        if bare.startswith("#  - "):  # an example of the key above
            continue
        if bare.startswith("#"):
            above.append(bare.removeprefix("#").strip())
            continue
        found = LINE.match(line)
        if found is None:
            continue
        split = COMMENT.match(found["rest"] or "")
        value, comment = (split["value"].strip(), split["comment"]) if split else ("", None)
        path = [(at, name) for at, name in path if at < depth] + [(depth, found["key"])]
        told = " ".join([*above, *([comment] if comment else [])])
        above = []
        sentence = found["key"] in SENTENCES or "words" in [name for _, name in path[:-1]]
        if found["key"] in UNTOLD or (len(path) > 2 and sentence):
            hidden = depth
            continue
        if value == "|":
            block, value = depth, "(several lines)"
        if value or told:
            yield Key(prefix + ".".join(name for _, name in path), value, told)


def paragraph(lines: list[str]) -> str:
    """Converts comment lines to prose; indented ones are commands."""
    text = ""
    for line in lines:
        if line.startswith("  "):
            text += f"\n\n    {line.strip()}\n"
        else:
            text += ("\n" if text.endswith("\n") else " " if text else "") + line
    return text + "\n"


def code(value: str) -> str:
    """Formats a value as code, and shortens long values."""
    if not value:
        return ""
    shown = value if len(value) <= 60 else value[:57] + "..."
    return f"`{shown}`".replace("|", "\\|")


def cell(text: str) -> str:
    """Escapes prose for a table."""
    return text.replace("|", "\\|")


if __name__ == "__main__":
    sys.exit(main())
