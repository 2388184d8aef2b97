"""Saved types predict as before; a manipulated file is refused and never executed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from sklearn.ensemble import GradientBoostingClassifier, RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.tree import DecisionTreeClassifier

from tests.refusals import refused
from xplain import Clustering, Dataset, InputError, LabelerTrainer, LearnedTypes
from xplain.explanation.habits import Habits
from xplain.learning.data.label_file import encode_transition, read_table
from xplain.learning.user_types import learn_types

HABITS = Habits([0.0, 0.2], [1.0, 0.8], [0.0, 0.1], [0.5, 0.5])


def learned(classifier, confidence="accuracy"):
    """Learns two types: one needs message 0 where the first feature is large, the other message
    1."""
    rng = np.random.default_rng(0)
    features = rng.integers(0, 4, (40, 2)).astype(float)
    transition, given, observer = (rng.integers(0, most, 400) for most in (40, 8, 4))
    needed = (features[transition, 0] > 1) & (given >> (observer // 2) & 1 == 0)
    names = ("row", "column"), ("a", "b", "c"), ("o0", "o1", "o2", "o3")
    data = Dataset(features, *names, observer, transition, given, 1 - needed.astype(np.uint8))
    clustering = Clustering(np.array([0, 0, 1, 1]), "given", "given")
    trainer = LabelerTrainer(classifier, confidence=confidence)
    types = learn_types(data, clustering, trainer, 0)
    return replace(LearnedTypes.of(types, data, {"a": "All is well."}), habits=HABITS), data


# Some processors' matrix products raise the flag of numbers that they read beyond the matrix.
@pytest.mark.filterwarnings("ignore:invalid value encountered in matmul:RuntimeWarning")
def array_of(types, rows):
    """Computes the label table [N, T, 2^n] of rows of features."""
    return types.label_table(rows).array(len(types.messages))


@pytest.mark.parametrize("confidence", ["accuracy", "leaf"])
@pytest.mark.parametrize(
    "classifier",
    [
        DecisionTreeClassifier(),
        DecisionTreeClassifier(max_depth=2, min_samples_leaf=7),
        RandomForestClassifier(5),
        GradientBoostingClassifier(n_estimators=5),
        LogisticRegression(),
    ],
    ids=lambda c: type(c).__name__,
)
def test_what_was_saved_says_the_same(tmp_path, classifier, confidence):
    types, data = learned(classifier, confidence)
    types.save(tmp_path / "types")
    again = LearnedTypes.load(tmp_path / "types")
    rows = np.vstack([data.features, np.random.default_rng(1).normal(0, 9, (50, 2))])
    np.testing.assert_array_equal(array_of(types, rows), array_of(again, rows))
    sets = np.arange(len(rows)) % 8
    for before, after in zip(types.labelers, again.labelers, strict=True):
        for ask in ("predict", "probability"):
            np.testing.assert_array_equal(
                getattr(before, ask)(rows, sets), getattr(after, ask)(rows, sets)
            )
    assert (again.names, again.messages, again.feature_names, again.sentences) == (
        types.names,
        ("a", "b", "c"),
        ("row", "column"),
        {"a": "All is well."},
    )
    for name in ("error", "accept", "forget", "prior"):
        assert np.array_equal(getattr(again.habits, name), getattr(HABITS, name))
    again.save(tmp_path / "types")
    twice = LearnedTypes.load(tmp_path / "types")
    np.testing.assert_array_equal(array_of(twice, rows), array_of(again, rows))


class Mine(LogisticRegression):
    """A class outside scikit-learn."""


def test_a_class_that_nobody_vouched_for_is_not_built(tmp_path):
    types, data = learned(Mine())
    types.save(tmp_path / "types.npz")
    with pytest.raises(InputError, match=r"Mine.*trusted="):
        LearnedTypes.load(tmp_path / "types.npz")
    name = f"{Mine.__module__}.Mine"
    again = LearnedTypes.load(tmp_path / "types.npz", trusted=[name])
    np.testing.assert_array_equal(array_of(again, data.features), array_of(types, data.features))


WRONG_HABITS = {"error": [0.0, 0.7], "prior": [0.5, 0.6], "accept": [0.5] * 7, "forget": [-0.1, 0]}
CHANGES = {  # by the text of a file, which names the arrays of the fields, and its arrays
    "classifier": lambda text, arrays: arrays.update(
        {text["labelers"][0]["skops"]: np.zeros(9, np.uint8)}
    ),
    "field": lambda text, _: text.update(format=77),
    "names": lambda _, arrays: arrays.update(names=np.append(arrays["names"], "one more")),
    "prior": lambda text, arrays: arrays.update({text["prior"]: np.ones(1)}),
    "messages": lambda _, arrays: arrays.update(messages=np.array([f"m{j}" for j in range(70)])),
    "confidence": lambda text, _: text["labelers"][0].update(confidence="high"),
    "pickled": lambda text, arrays: arrays.update({text["prior"]: np.array([text, text])}),
    **{
        f"habits.{key}": lambda text, arrays, key=key, value=value: arrays.update(
            {text["habits"][key]: np.array(value)}
        )
        for key, value in WRONG_HABITS.items()
    },
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_doctored_file_is_refused_in_one_line(tmp_path, name):
    path = tmp_path / "types.npz"
    learned(DecisionTreeClassifier())[0].save(path)
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    text = json.loads(arrays["types"].item())
    CHANGES[name](text, arrays)
    with path.open("wb") as file:
        np.savez(file, **arrays | {"types": np.array(json.dumps(text))})
    with refused("="):
        LearnedTypes.load(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("left_child", 0),  # a circle, on which a walk would never end
        ("right_child", 10**6),  # outside of the arrays
        ("left_child", -1),
        ("left_child", -7),
        ("feature", 99),
        ("feature", -5),
    ],
)
@pytest.mark.parametrize("inside", [False, True])
def test_a_doctored_tree_is_refused_in_one_line(tmp_path, key, value, inside):
    classifier = RandomForestClassifier(2) if inside else DecisionTreeClassifier()
    types, _ = learned(classifier)
    fitted = types.labelers[0].classifier
    own = fitted.estimators_[1] if inside else fitted
    state = own.tree_.__getstate__()
    state["nodes"][key][0] = value
    own.tree_.__setstate__(state)
    types.save(tmp_path / "types.npz")
    with refused("classifier of type 0"):
        LearnedTypes.load(tmp_path / "types.npz")


def test_a_transition_is_encoded_from_its_columns_as_the_table_was(tmp_path):
    """Whatever the order of columns: every row of a table with text comes out as it was read."""
    rng = np.random.default_rng(1)
    rows = [
        {"load": int(rng.integers(3)), "zone": str(rng.choice(["river", "hill=steep", "2"]))}
        for _ in range(30)
    ]
    lines = [
        f"o{i % 3},{'a' if i % 2 else ''},{int(row['load'] > 1)},{row['zone']},{row['load']}"
        for i, row in enumerate(rows)
    ]
    path = tmp_path / "labels.csv"
    path.write_text("\n".join(["observer,messages,label,zone,load", *lines]) + "\n")
    data = read_table(path)
    assert set(data.feature_names) == {"load", "zone=river", "zone=hill=steep", "zone=2"}
    for row, transition in zip(rows, data.transition, strict=True):
        assert encode_transition(row, data.feature_names) == tuple(data.features[transition])


@pytest.mark.parametrize(
    ("transition", "named"),
    [
        ({"load": 1}, "zone"),
        ({"zone": "river"}, "load"),
        ({"zone": "sea", "load": 1}, "river, hill"),
        ({"zone": "river", "load": "heavy"}, "number"),
        ({"zone": "river", "load": 1, "speed": 2}, "speed"),
    ],
)
def test_what_cannot_be_encoded_is_refused_by_name(transition, named):
    with pytest.raises(InputError, match=named):
        encode_transition(transition, ("zone=river", "load", "zone=hill"))
