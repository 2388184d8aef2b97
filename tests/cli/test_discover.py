"""Tests ``python -m xplain observe`` and ``python -m xplain discover`` as a person uses them."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import adjusted_rand_score

import xplain
from tests.refusals import line_of, refused
from xplain.errors import XplainError
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import Single
from xplain.runs.labels import sentences_of

pytestmark = pytest.mark.usefixtures("no_pictures")


@dataclass(frozen=True)
class Everybody(Single):
    """A user's own component, whose labeler contains an object of scikit-learn."""

    weight: float = 1.0


def test_types_of_simulated_observers_are_found_again(run, tmp_path: Path) -> None:
    options = ("observers.label_noise=0.02", "output=labels.csv")
    code, out, _ = run("observe", "domain=rescue", *options)
    assert code == 0
    told = json.loads(out.splitlines()[-1])
    known = pd.read_csv(tmp_path / told["truth"])
    labels = pd.read_csv(tmp_path / "labels.csv")
    assert [told[key] for key in ("observers", "labels")] == [len(known), len(labels)]
    assert list(known.columns) == ["observer", "type", "behaves_like"]

    (tmp_path / "said.yaml").write_text("fire: Fires can be put out.\n")
    words = ("data=labels.csv", "output=found", "sentences=said.yaml")
    code, out, err = run("discover", *words)
    assert code == 0, err
    answer = json.loads(out.splitlines()[-1])
    figures = {"n_types", "held_out", "held_out_log_likelihood", "seconds"}
    assert set(answer) == {"assignment", "method", "rule"} | figures
    assert answer["assignment"].keys() == set(known["observer"])
    found = [answer["assignment"][observer] for observer in known["observer"]]
    assert adjusted_rand_score(known["behaves_like"], found) == 1
    assert answer["n_types"] == 5
    assert answer["held_out_log_likelihood"] < 0

    types = LearnedTypes.load(tmp_path / "found" / "types.npz")
    assert types.names == tuple(f"type_{t}" for t in range(5))
    assert types.sentences == {"fire": "Fires can be put out."}
    summary = json.loads((tmp_path / "found" / "summary.json").read_text())
    labels = labels["label"].groupby(labels["observer"].map(answer["assignment"]))
    said = " ".join(out.split())
    for one in summary["types"]:  # the figures of the file and of the printed table
        own, needs = labels.get_group(one["name"]), ", ".join(one["needs"])
        counts = (found.count(one["name"]), len(own), pytest.approx(own.mean()))
        assert (one["observers"], one["labels"], one["explicable"]) == counts
        shares = f"{own.mean():.1%} {one['confidence']:.3f}"
        assert f"{one['name']} {needs} {one['observers']} {len(own)} {shares}" in said
    assert [set(one["needs"]) for one in summary["types"]] == [  # types A to E
        {"fire", "rubble"},
        {"first_aid", "fence"},
        {"fire", "puddle"},
        {"first_aid", "rubble"},
        {"refuel", "puddle"},
    ]
    assert pd.read_csv(tmp_path / "found" / "assignment.csv")["type"].tolist() == found
    for picture in ("posterior", "messages", "calibration"):
        assert (tmp_path / "found" / f"{picture}.png").is_file()
    tenths = summary["calibration"]
    assert len(tenths) == 10
    assert sum(one["labels"] for one in tenths) == pytest.approx(told["labels"] / 4, rel=0.1)
    off = max(abs(one["said"] - one["ones"]) for one in tenths)
    assert f"largest error in a tenth of the held-out labels {off:.3f}" in said
    for key in ("types", "one_type", "question_mean"):
        assert f"{key.replace('_', ' ')} {-answer['held_out'][key]:.3f}" in said


@pytest.mark.parametrize("method", ["dirichlet", "kmeans", "agglomerative", "single"])
def test_every_method_bears_what_people_do(run, tmp_path: Path, caplog, method: str) -> None:
    """Data may have one label only, always the same label, or both answers to a question."""
    assert run("observe", "domain=rescue", "points=40", "observers.per_type=1")[0] == 0
    table = pd.read_csv(tmp_path / "labels.csv", keep_default_na=False)
    own = [part for _, part in table.groupby("observer")]
    own[0] = own[0].head(1)
    own[1] = own[1].assign(label=1)
    own[2] = pd.concat([own[2], own[2].assign(label=1 - own[2]["label"])])
    pd.concat(own).to_csv(tmp_path / "labels.csv", index=False)
    code, out, err = run("discover", "data=labels.csv", f"clusterer={method}")
    assert code == 0, err
    assert "1 observers gave only one label" in caplog.text
    assert "answered both ways by one observer" in caplog.text
    answer = json.loads(out.splitlines()[-1])
    assert answer["method"] == method
    # The paper's learner draws its curve.
    assert (tmp_path / "outputs/discover/curve.png").is_file() or method != "kmeans"
    assert len(answer["assignment"]) == 5
    assert 1 <= answer["n_types"] <= 5
    assert answer["held_out_log_likelihood"] < 0


ROWS = [f"{o},m{i % 3},{i},{(i + (o == 'b')) % 2}" for o in "ab" for i in range(9)]
FILES = {
    "bad.csv": "who,label\na,1\n",
    "good.csv": "\n".join(["observer,messages,place,label", *ROWS]),
    "no_number.csv": "observer,messages,place\na,m0,a\n",
    "unheard.csv": "observer,messages,place\na,unheard,1\n",
    "nobody.csv": "messages,place\nm0,1\n",
}


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("discover", (), "data"),
        ("discover", ("data=none.csv",), "no such file"),
        ("discover", ("data=bad.csv",), "lacks the column observer"),
        ("discover", ("dat=bad.csv",), "dat"),
        ("discover", ("data=good.csv", "clusterer=perfect"), "clusterer"),
        ("discover", ("data=good.csv", "clusterer=magic"), "unknown choice"),
        ("discover", ("data=good.csv", "messages=[m0]"), "unknown message"),
        ("discover", ("data=good.csv", "features=[colour]"), "colour"),
        ("discover", ("data=good.csv", "output=good.csv"), "output"),
        ("discover", ("data=good.csv", "seed=-1"), "seed"),
        ("discover", ("data=good.csv", "predict=no_number.csv"), "no number"),
        ("discover", ("data=good.csv", "predict=unheard.csv"), "unknown message"),
        ("discover", ("data=good.csv", "predict=nobody.csv"), "lacks the column observer"),
        # True labels are nothing that a file of labels can be learned with.
        ("discover", ("data=good.csv", "labeler=truth", "clusterer=kmeans"), "labeler='truth': "),
        ("discover", ("data=good.csv", "labeler=truth"), "labeler='truth': "),
        ("observe", ("output=x.txt",), "output"),
        ("observe", ("truth=labels.csv",), "truth"),
        ("observe", ("observers.points=0",), "observers.points"),
        ("observe", ("observers.label_noise=2",), "observers.label_noise"),
        ("observe", ("domain=mars",), "unknown choice"),
        ("observe", ("seed=-1",), "seed"),
        ("questions", ("seed=-1",), "seed"),
        ("observe", ("queries=magic",), "unknown choice"),
        ("observe", ("queries.trace_length=0",), "queries.trace_length"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    run, tmp_path: Path, command: str, arguments: tuple[str, ...], said: str
) -> None:
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    assert said in line_of(run(command, *arguments))
    assert {path.name for path in tmp_path.iterdir()} == FILES.keys()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("flood: Beware.", "flood"),
        ("- fire", "lines 'message: text'"),
        ("fire: [1]", "lines 'message: text'"),
        (None, "lines 'message: text'"),
    ],
)
def test_sentences_that_cannot_be_used_are_refused(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "said.yaml"
    if text is not None:
        path.write_text(text)
    with refused(named):
        sentences_of(str(path), ("fire", "fence"))


def test_answers_are_predicted_where_nobody_was_told_anything(run, tmp_path: Path) -> None:
    """Two kinds of people, who answer the first or the second half of ten items with 1."""
    rng = np.random.default_rng(0)
    kind = np.arange(40) % 2
    own = (np.arange(10) // 5 == kind[:, None]) ^ (rng.random((40, 10)) < 0.1)
    observer, item = np.nonzero(np.ones_like(own))
    table = pd.DataFrame({"observer": observer, "item": item, "label": own.ravel().astype(int)})
    held = rng.random(len(table)) < 0.2
    table[~held].to_csv(tmp_path / "labels.csv", index=False)
    new = pd.DataFrame({"observer": ["somebody"], "item": [3]})
    asked = pd.concat([table[held].drop(columns="label"), new]).sample(frac=1, random_state=1)
    asked.to_csv(tmp_path / "asked.csv", index=False)
    code, out, err = run("discover", "data=labels.csv", "predict=asked.csv", "output=found")
    assert code == 0, err
    assert "types predict held-out answers better" in " ".join(out.split())
    answer = json.loads(out.splitlines()[-1])
    kinds = [kind[int(name)] for name in answer["assignment"]]
    assert adjusted_rand_score(kinds, list(answer["assignment"].values())) > 0.8
    assert answer["held_out"]["gain"][0] > 0
    found = pd.read_csv(tmp_path / "found" / "predictions.csv")
    assert found.drop(columns="p").astype(str).equals(asked.astype(str).reset_index(drop=True))
    known = found[found["observer"] != "somebody"]
    likely = known["p"] > 0.5
    true = known["item"].astype(int) // 5 == known["observer"].astype(int) % 2
    assert (likely == true).all()
    stranger = found.loc[found["observer"] == "somebody", "p"].item()
    assert stranger == pytest.approx(own[:, 3].mean(), abs=0.1)


def test_told_answers_are_predicted_by_types_and_ones_own_labels(run, tmp_path: Path) -> None:
    options = ("domain=rescue", "points=60", "output=labels.csv")
    assert run("observe", *options)[0] == 0
    table = pd.read_csv(tmp_path / "labels.csv", keep_default_na=False)
    held = np.random.default_rng(0).random(len(table)) < 0.2
    table[~held].to_csv(tmp_path / "some.csv", index=False)
    table[held].to_csv(tmp_path / "rest.csv", index=False)
    code, _, err = run(
        "discover", "data=some.csv", "predict=rest.csv", "held_out=false", "output=found"
    )
    assert code == 0, err
    found = pd.read_csv(tmp_path / "found" / "predictions.csv", keep_default_na=False)
    right = np.where(found["label"] == 1, found["p"], 1 - found["p"])
    mean = np.where(found["label"] == 1, table["label"].mean(), 1 - table["label"].mean())
    assert np.log(right).mean() > np.log(mean).mean() + 0.05


def test_python_is_given_what_the_command_writes(run, tmp_path: Path, monkeypatch) -> None:
    output = "new/folder/labels.parquet"
    assert run("observe", "domain=rescue", f"output={output}", "points=30")[0] == 0
    code, out, _ = run("discover", f"data={output}", "output=there", "seed=3")
    assert code == 0
    monkeypatch.chdir(tmp_path)
    found = xplain.discover(output, seed=3, output=tmp_path / "here")
    row = json.loads(out.splitlines()[-1])
    assert found.row["assignment"] == row["assignment"]
    assert json.loads(json.dumps(found.row["held_out"])) == row["held_out"]
    names = {path.name for path in (tmp_path / "there").iterdir()}
    assert {path.name for path in (tmp_path / "here").iterdir()} == names
    assert {f"{name}.png" for name in found.plot()} == {n for n in names if n.endswith("png")}
    assert found.frame()["observers"].sum() == len(row["assignment"])
    frame = pd.read_parquet(output)
    same = xplain.discover(frame, seed=3, held_out=False, clusterer="kmeans")
    assert same.types.clustering.method == "kmeans"
    assert same.row["held_out_log_likelihood"] is None
    assert same.dataset.feature_names == found.dataset.feature_names
    one = xplain.discover(frame, ignore=["row"], held_out=False, clusterer=Everybody(weight=2.0))
    assert (one.types.clustering.n_types, "row" in one.dataset.feature_names) == (1, False)
    for words, said in ((("absent.csv",), "no such file"), ((frame, "seed=1,2"), "one value;")):
        with pytest.raises(XplainError, match=said):
            xplain.discover(*words)
