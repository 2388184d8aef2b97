"""The command line for a person: errors are one line, and no file is written partly."""

import errno
from functools import partial

import pytest

from tests.configurations import composed
from tests.conftest import Run
from tests.refusals import line_of
from xplain.experiment.config import CONF, report_errors
from xplain.report import stages


@pytest.fixture
def xplain(run: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """``xplain("lambda=2")`` runs the command, whose stages say nothing on a slow machine."""
    monkeypatch.setattr(stages, "EVERY", 600.0)
    return partial(run, "")


RAGGED = "domain.map='S..V\n...'"

SIX = ("first_aid", "fire", "refuel", "rubble", "puddle", "fence")
BAD = [
    (["solver=nonsense"], ["solver", "nonsense", "qmdp"]),
    (["trade_off=2"], ["trade_off", "did you mean lambda?"]),
    (["solver.memory=5"], ["solver.memory"]),
    (["solver=pomcp", "solver.simulation=3"], ["did you mean solver.simulations?"]),
    (["certify.trace=3"], ["did you mean certify.traces?"]),
    (
        ["domain=rescue", "users.count=3"],
        ["users.count: no such key; it needs users=few_facts or users=random_cover"],
    ),
    (
        ["domain=blocks", "domain.facts={jam: {change: {action: stack, cost: 2}}}"],
        [
            "domain.facts.jam: no such key; domain.facts has one_hand, tower",
            "+domain.facts.jam=… adds this key",
        ],
    ),
    (["domain=blocks", "domain.facts.towr.message=Yes"], ["did you mean domain.facts.tower?"]),
    (["discover"], ["xplain: data: has to be given: data=VALUE"]),
    (["message_cost.fire=2"], ["message_cost.fire: no such key; ", "message_cost={fire: 2, …}"]),
    (["sweep=table1"], ["did you mean sweeps?"]),
    (
        ["seed=1", "--lambda", "1.5"],
        ["xplain: --lambda: no such flag", "without dashes: lambda=1.5"],
    ),
    (["--lambda=1.5"], ["xplain: --lambda=1.5: no such flag", "without dashes: lambda=1.5"]),
    (["lambda=-1"], ["lambda", "-1", "≥ 0"]),
    (["lambda=much"], ["lambda='much': a number"]),
    (["discount=0"], ["discount", "0", "(0, 1]"]),
    (["seed=-3"], ["seed", "-3"]),
    (["message_cost=much"], ["message_cost", "much"]),
    (["message_cost={fire: 2}"], ["message_cost", "fire", "fence missing"]),
    (["message_cost={lava: 2}"], ["message_cost", "lava", "first_aid"]),
    ([f"message_cost={{{', '.join(f'{m}: -2' for m in SIX)}}}"], ["message_cost.first_aid", "-2"]),
    ([RAGGED], ["domain.map"]),
    (["domain.map='SVSAFUrpfs'"], ["domain.map", "shelter"]),
    (["domain.map='SV?'"], ["domain.map", "?"]),
    (["domain.map='SVAFUrpf#s'"], ["domain.map", "path"]),
    (["-m", "domain.map='SVAFUrpf#s'", "lambda=1,2"], ["domain.map"]),
    (["-m", "message_cost={fire: 2}", "lambda=1,2"], ["message_cost"]),
    (["domain.discount=1"], ["domain.discount", "1"]),
    (["points=1", "queries=shared"], ["xplain: points: too few", "two"]),
    (["solver=true"], ["solver", "true", "qmdp"]),
    (
        ["observers=file", "observers.path=absent.csv"],
        ["observers.path='absent.csv': no such file"],
    ),
    (["explainee=slips", "explainee.rate=1.5"], ["explainee.rate=1.5: a number in [0, 1]"]),
    (["explainee=heedless", "explainee.accept=-0.1"], ["explainee.accept=-0.1: a number in"]),
    (["explainee=heedless", "explainee.forget=2"], ["explainee.forget=2: a number in"]),
    (["sync", "nowhere"], ["folder='nowhere': a folder with results.json"]),
    (["resume=maybe"], ["resume", "maybe", "missing, failed, none"]),
    (["lambda=1,2"], ["lambda", "1,2", "add -m"]),
    (["labeler=true"], ["labeler", "true", "truth"]),
    (["lambda=1", "-m", "seed=1,2"], ["-m", "before all keys"]),
    (["tracking=null"], ["tracking", "null", "none"]),
    (["solver=null"], ["solver", "null", "a choice"]),
    (["solver=[qmdp,qhr]"], ["solver", "[qmdp,qhr]", "a choice"]),
    (["dry_run=maybe"], ["dry_run='maybe': true or false"]),
    (["~solver"], ["solver", "a choice"]),
    (["certify=null"], ["certify", "keys"]),
    (["--config-name=nowhere"], ["nowhere"]),
    (["--config-path=nowhere"], ["nowhere", "not found"]),
    (["lambda=0.5;1"], ["lambda=0.5;1", "commas"]),
    (["-m", "lambda=1,2", "hydra.sweeper.params=3"], ["hydra.sweeper.params", "3"]),
    (["-m", "lambda=1,2", "hydra.sweep.dir=mine"], ["hydra.sweep.dir", "mine", "outputs=FOLDER"]),
    (["sweeps=tabel1"], ["sweeps=tabel1", "did you mean table1?", "type_counts"]),
    (["users=explicit", "users.groups={}"], ["users", "at least one"]),
    (["users=explicit", "users.groups={A: [lava]}"], ["lava", "first_aid"]),
]
HEAD, STEP = "observer,messages,label,row,column", "row,column,action,next_row,next_column"
LABELS = [
    (f"observer,label,{STEP}\na,1,0,0,up,0,0\nb,0,0,0,up,0,0\n", ["messages"]),
    (f"{HEAD}\na,lava,1,0,0\nb,,0,0,0\n", ["lava"]),
    (f"{HEAD}\na,,2,0,0\nb,,0,0,0\n", ["label", "2"]),
    (f"{HEAD}\na,,1,0,0\na,fire,0,0,0\n", ["observer"]),
    (f"observer,messages,label,{STEP}\na,,1,0,0,up,0,0\nb,fire,1,0,0,up,0,0\n", ["label"]),
    (f"{HEAD}\n", ["labels.csv"]),
    ("\x00\x01", ["labels.csv"]),
    (f"{HEAD}\na,,1,0,0\na,,1,0,1\nb,fire,0,0,0\nb,fire,0,0,1\n", ["action", "missing"]),
]
USABLE = f"observer,messages,label,{STEP}\n" + "".join(
    f"{one},,{cell % 2},{cell},0,up,{cell},0\n" for one in "ab" for cell in range(4)
)
OF_FILE = ["observers=file", "observers.path=labels.csv"]


@pytest.mark.parametrize(
    ("arguments", "words", "labels"),
    [
        *(pytest.param(*one, None, id=" ".join(one[0])[:40]) for one in BAD),
        *(pytest.param(OF_FILE, words, labels) for labels, words in LABELS),
        (["observe", *OF_FILE], ["observers='file': simulated"], USABLE),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing_behind(
    xplain, tmp_path, arguments, words, labels
):
    file = tmp_path / "labels.csv"
    if labels:
        file.write_text(labels)
    line = line_of(xplain(*arguments))
    assert [word for word in words if word not in line] == []
    file.unlink(missing_ok=True)
    # Locks are empty and cannot be removed safely.
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".lock"]


def test_a_misspelt_key_lists_every_key_that_there_is(xplain):
    line = line_of(xplain("lamda=2"))
    assert "did you mean lambda?" in line
    listed = {word.strip() for word in line.partition("allowed:")[2].split(",")}
    assert listed == set(composed()) | {"sweeps"}


@pytest.mark.parametrize("overrides", [True, False])
def test_a_domain_file_without_its_package_is_told_the_line(xplain, tmp_path, overrides):
    folder = tmp_path / "mine" / "domain"
    folder.mkdir(parents=True)
    text = (CONF / "domain" / "four_rooms.yaml").read_text().replace("# @package _global_\n", "")
    if not overrides:
        text = text.replace("defaults:\n  - override /users: random_cover\n", "")
    (folder / "my_rooms.yaml").write_text(text)
    line = line_of(xplain(f"--config-dir={tmp_path / 'mine'}", "domain=my_rooms"))
    assert "# @package _global_" in line


@pytest.mark.parametrize("sweep", [(), ("-m", "lambda=1,2")])
def test_malformed_yaml_is_one_line_with_its_place(xplain, tmp_path, sweep):
    folder = tmp_path / "mine" / "solver"
    folder.mkdir(parents=True)
    (folder / "broken.yaml").write_text("depth: [1\nwidth: }\n")
    line = line_of(xplain(f"--config-dir={tmp_path / 'mine'}", *sweep, "solver=broken"))
    assert line.startswith(f"xplain: {folder / 'broken.yaml'}: line 2: ")
    assert "absent' not found" in line_of(xplain("--config-dir=absent", "solver=broken"))


def test_every_command_knows_choices_of_ones_own(xplain, tmp_path):
    folder = tmp_path / "mine" / "domain"
    folder.mkdir(parents=True)
    (folder / "my_rooms.yaml").write_text((CONF / "domain" / "four_rooms.yaml").read_text())
    for command in ("demo", "questions"):
        for flag in (("--config-dir", str(folder.parent)), (f"-cd={folder.parent}",)):
            line = line_of(xplain(command, *flag, "domain=my_room"))
            assert "did you mean my_rooms?" in line
        line = line_of(xplain(command, "--config-dir", "absent", "domain=my_rooms"))
        assert "a folder with choices of your own" in line


@pytest.mark.parametrize("name", [None, "run/trace.png"])
def test_a_full_disk_is_one_line(name, capsys):
    with pytest.raises(SystemExit), report_errors():
        raise OSError(errno.ENOSPC, "No space left on device", name)
    where = "" if name is None else f"{name}: "
    assert capsys.readouterr().err == f"xplain: {where}No space left on device\n"


def test_an_interruption_that_an_import_made_another_error_of_is_told_as_one(capsys):
    half = ImportError("half of a module")
    half.__cause__ = KeyboardInterrupt()
    with pytest.raises(SystemExit) as ended, report_errors():
        raise half
    assert ended.value.code == 130
    assert capsys.readouterr().err == "xplain: interrupted\n"


def test_an_output_folder_that_cannot_be_written_is_one_line(tmp_path, xplain):
    (tmp_path / "outputs").write_text("a file, where a folder is wanted")
    assert "outputs" in line_of(xplain("tracking=none"))
