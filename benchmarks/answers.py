"""Predicts left-out answers of real people, with `xplain discover … predict=` and other methods.

    python benchmarks/answers.py --data FOLDER   every NAME.csv in it (observer, item, label)
    python benchmarks/answers.py --examinees     an adaptive test of simulated examinees
    python benchmarks/answers.py --quick         simulated pupils, one split; few examinees

In each of three random splits a fifth of the answers is left out. All methods see the same answers,
and have only these options: `discover, hypotheses` also knows the skills of each item
(labeler=hypotheses); `question's mean` smooths by one answer of either kind; `Rasch` is a logistic
regression on persons and items; `DINA` (Junker & Sijtsma 2001) takes the skills of NAME_items.csv
(item, inexplicable_if: skills joined by `;`), with slips and guesses by item and shares of the 2^n
profiles by expectation maximisation; `classes` are StepMix's latent classes, their number by BIC
(needs `pip install 'xplain-hri[bench]'`); `mixture k` has k classes, shrunk to the question's mean
with the weight of five answers.

If a table has answers before and after messages (column `messages`), the later answers of a third
of the people are left out. The other methods are then the question's mean, question x the person's
own earlier answer, and a logistic regression on question, own earlier answer and earlier score.

Other people's tables are not in the repository. The measured tables are: fractions, K. Tatsuoka's
data in the R package CDM (data.fraction1); skateboard, from SUCCESS-MURI/psiturk-machine-teaching
on GitHub.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import logsumexp
from sklearn.linear_model import LogisticRegression

from xplain import Hypotheses, Questionnaire
from xplain.learning.prediction import CalibrationBin, calibration

Table = NDArray[np.float64]
"""[O, T] answers; NaN if an answer is missing or left out."""
Method = Callable[[Table, Table | None], Table]
"""Returns P(answer 1) [O, T] from the answers and the skills of each item."""
WEIGHT = 5.0


def mean(answers: Table, _: Table | None) -> Table:
    """Predicts the question's mean."""
    asked = ~np.isnan(answers)
    value = (np.nansum(answers, axis=0) + 1) / (asked.sum(axis=0) + 2)
    return np.broadcast_to(value, answers.shape)


def rasch(answers: Table, _: Table | None) -> Table:
    """Fits ability and difficulty, each with a normal prior of variance 1."""
    o, t = np.nonzero(~np.isnan(answers))
    both = np.hstack([np.eye(len(answers))[o], np.eye(answers.shape[1])[t]])
    model = LogisticRegression(C=1.0, max_iter=1000).fit(both, answers[o, t])
    ability, ease = np.split(model.coef_[0], [len(answers)])
    return 1 / (1 + np.exp(-(ability[:, None] + ease + model.intercept_[0])))


def mixture(k: int, seed: int = 0) -> Method:
    """Fits k classes, the best of three starts."""

    def expected(answers: Table, _: Table | None) -> Table:
        asked, centre = ~np.isnan(answers), mean(answers, None)[0]
        ones, zeros = np.nan_to_num(answers), asked - np.nan_to_num(answers)
        best, result = -np.inf, np.zeros(answers.shape)
        for start in range(3):
            weight = np.random.default_rng((seed, start)).dirichlet(np.ones(k), len(answers))
            before = -np.inf
            for _ in range(300):
                one = (weight.T @ ones + WEIGHT * centre) / (weight.T @ asked + WEIGHT)
                share = (weight.sum(axis=0) + 1) / (len(answers) + k)
                joint = ones @ np.log(one).T + zeros @ np.log(1 - one).T + np.log(share)
                total = logsumexp(joint, axis=1)
                weight = np.exp(joint - total[:, None])
                if total.sum() - before < 1e-5:
                    break
                before = total.sum()
            if total.sum() > best:
                best, result = total.sum(), weight @ one
        return result

    return expected


def dina(answers: Table, needed: Table | None) -> Table:
    """Fits DINA; ``needed`` [T, n] has the skills of each item."""
    assert needed is not None
    n = needed.shape[1]
    held = np.arange(1 << n)[:, None] >> np.arange(n) & 1
    able = (held @ needed.T == needed.sum(axis=1)).astype(float)  # [2^n, T]
    asked = ~np.isnan(answers)
    ones, zeros = np.nan_to_num(answers), asked - np.nan_to_num(answers)
    slip, guess = np.full((2, len(needed)), 0.2)
    share = np.full(1 << n, 1 / (1 << n))
    for _ in range(500):
        one = np.where(able == 1, 1 - slip, guess)
        joint = ones @ np.log(one).T + zeros @ np.log(1 - one).T + np.log(share)
        weight = np.exp(joint - logsumexp(joint, axis=1, keepdims=True))
        share = (weight.sum(axis=0) + 0.1) / (len(answers) + 0.1 * len(share))
        of_ones, of_zeros = weight.T @ ones, weight.T @ zeros
        slip = ((able * of_zeros).sum(axis=0) + 1) / ((able * (of_ones + of_zeros)).sum(axis=0) + 5)
        unable = 1 - able
        guess = (unable * of_ones).sum(axis=0) + 1
        guess /= (unable * (of_ones + of_zeros)).sum(axis=0) + 5
    return weight @ one


def classes(answers: Table, _: Table | None) -> Table:
    """Fits StepMix with one to eight classes; BIC chooses the number."""
    from stepmix.stepmix import StepMix

    found = [
        StepMix(k, measurement="binary_nan", n_init=3, random_state=0, progress_bar=0).fit(answers)
        for k in range(1, 9)
    ]
    best = min(found, key=lambda model: model.bic(answers))
    one = np.stack([best.get_parameters()["measurement"]["pis"]])[0].reshape(-1, answers.shape[1])
    return best.predict_proba(answers) @ one


def discovered(answers: Table, needed: Table | None, labels: Table, folder: Path) -> Table:
    """Returns [O, T] P(answer 1) of left-out answers by ``xplain discover``, run as a user does;
    NaN for all others. If skills are given, people lack some skills, and answer 0 to items that
    need a lacked skill."""
    given, left = np.nonzero(~np.isnan(answers)), np.nonzero(np.isnan(answers) & ~np.isnan(labels))
    names = {"observer": [f"p{o:05d}" for o in given[0]], "item": given[1]}
    told = pd.DataFrame(names | {"label": answers[given].astype(int)})
    asked = pd.DataFrame({"observer": [f"p{o:05d}" for o in left[0]], "item": left[1]})
    result = np.full(answers.shape, np.nan)
    result[left] = predicted(told, asked, needed, folder)
    return result


def predicted(
    told: pd.DataFrame, asked: pd.DataFrame, needed: Table | None, folder: Path
) -> NDArray[np.float64]:
    """Returns the P(answer 1) that ``xplain discover`` predicts for the rows ``asked``. Skills
    ``needed`` [T, n] have the names skill_0, skill_1, …, as in the tables' messages."""
    told.to_csv(folder / "given.csv", index=False)
    asked.to_csv(folder / "left.csv", index=False)
    command = [sys.executable, "-m", "xplain", "discover", "data=given.csv", "predict=left.csv"]
    options = ["features=[item]", "held_out=false"]
    if needed is not None:
        count, skills = needed.shape
        masks = needed.astype(int) @ (1 << np.arange(skills))
        Hypotheses.of(
            (np.arange(1 << skills)[:, None] & masks) == 0,
            messages=[f"skill_{j}" for j in range(skills)],
            features=np.arange(count, dtype=float)[:, None],
            feature_names=("item",),
        ).save(folder / "skills.npz")
        options += ["labeler=hypotheses", "hypotheses=skills.npz"]
    done = subprocess.run([*command, *options], cwd=folder, check=True, capture_output=True)
    print(
        "\n".join(
            line for line in done.stdout.decode().splitlines() if line.startswith("acceptance of ")
        )
    )
    return pd.read_csv(folder / "outputs/discover/predictions.csv")["p"].to_numpy()


def nats(one: Table, labels: Table, left: NDArray[np.bool_]) -> float:
    """Computes the mean loss of a left-out answer, in nats."""
    p = np.clip(one[left], 1e-6, 1 - 1e-6)
    return float(-np.log(np.where(labels[left] == 1, p, 1 - p)).mean())


def table_of(path: Path) -> tuple[Table, Table | None]:
    """Reads the answers, and the skills of each item if there is a file of them."""
    wide = pd.read_csv(path).pivot_table("label", "observer", "item", aggfunc="first")
    items = path.with_name(f"{path.stem}_items.csv")
    if not items.exists():
        return wide.to_numpy(float), None
    said = pd.read_csv(items).set_index("item")["inexplicable_if"].loc[wide.columns]
    skills = skills_of(path)
    needed = [[float(one in own.split(";")) for one in skills] for own in said]
    return wide.to_numpy(float), np.array(needed)


def skills_of(path: Path) -> list[str]:
    """Reads the skills in the file beside a table; returns an empty list without such a file."""
    items = path.with_name(f"{path.stem}_items.csv")
    if not items.exists():
        return []
    return sorted({one for own in pd.read_csv(items)["inexplicable_if"] for one in own.split(";")})


def simulated(pupils: int = 200) -> tuple[Table, Table]:
    """Simulates pupils, ten items and three skills."""
    rng = np.random.default_rng(0)
    needed = (rng.random((10, 3)) < 0.5).astype(float)
    needed[needed.sum(axis=1) == 0, 0] = 1
    skilled = rng.random((pupils, 3)) < 0.6
    able = skilled.astype(float) @ needed.T == needed.sum(axis=1)
    return (rng.random(able.shape) < np.where(able, 0.9, 0.15)).astype(float), needed


def compare(name: str, labels: Table, needed: Table | None, splits: int) -> None:
    """Prints the table of one data set."""
    methods: dict[str, Method] = {"question's mean": mean, "Rasch": rasch}
    if needed is not None:
        methods["DINA"] = dina
    try:
        import stepmix  # noqa: F401

        methods["classes"] = classes
    except ImportError:
        print("(no StepMix: pip install 'xplain-hri[bench]')")
    methods["mixture 3"], methods["mixture 5"] = mixture(3), mixture(5)
    rows: dict[str, list[float]] = {}
    seconds: dict[str, list[float]] = {}
    found: dict[str, list[Table]] = {}
    label = []
    ways = (
        {"discover": None} if needed is None else {"discover": None, "discover, hypotheses": needed}
    )
    for split in range(splits):
        rng = np.random.default_rng((split, 1))
        left = ~np.isnan(labels) & (rng.random(labels.shape) < 0.2)
        answers = np.where(left, np.nan, labels)
        for method, expected in methods.items():
            rows.setdefault(method, []).append(nats(expected(answers, needed), labels, left))
        for way, known in ways.items():
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                one = discovered(answers, known, labels, Path(folder))
                seconds.setdefault(way, []).append(time.perf_counter() - began)
            rows.setdefault(way, []).append(nats(one, labels, left))
            found.setdefault(way, []).append(one[left])
        label.append(labels[left])
    print(f"\n## {name}: {labels.shape[0]} people, {labels.shape[1]} questions\n")
    print(
        "nats per left-out answer | " + " | ".join(f"split {k}" for k in range(splits)) + " | mean"
    )
    print(" | ".join(["---"] * (splits + 2)))
    for method, values in rows.items():
        print(f"{method} | " + " | ".join(f"{v:.3f}" for v in (*values, np.mean(values))))
    print()
    rng = np.random.default_rng(0)
    for way, parts in found.items():
        said, given = np.concatenate(parts), np.concatenate(label)
        tenths = calibration(said, given)
        inside = sum(one.low <= one.said <= one.high for one in tenths)
        perfect = [worst(calibration(said, rng.random(len(said)) < said)) for _ in range(500)]
        print(
            f"{way}: {np.mean(seconds[way]):.1f} s; calibration is off by at most "
            f"{worst(tenths):.3f} in a tenth; {inside} of ten are within their intervals. Right "
            f"probabilities would be off by {np.median(perfect):.3f} in the median, and by less "
            f"than 0.05 with probability {np.mean(np.array(perfect) < 0.05):.2f}"
        )


def own_earlier(before: Table, after: Table) -> Table:
    """Predicts the mean of people with the same earlier answer to the question."""
    taught, result = ~np.isnan(after[:, 0]), np.empty(before.shape)
    for answer in (0, 1):
        same = (before == answer) & taught[:, None]
        mean = (np.nansum(after * same, axis=0) + 1) / (same.sum(axis=0) + 2)
        result = np.where(before == answer, mean, result)
    return result


def by_score(before: Table, after: Table) -> Table:
    """Fits a logistic regression on the question, its earlier answer and the earlier score."""
    o, t = np.indices(before.shape).reshape(2, -1)
    known = ~np.isnan(after[o, t])
    inputs = np.column_stack([np.eye(before.shape[1])[t], before[o, t], before.mean(axis=1)[o]])
    model = LogisticRegression(max_iter=2000).fit(inputs[known], after[o, t][known])
    return model.predict_proba(inputs)[:, 1].reshape(before.shape)


def after_teaching(path: Path, splits: int) -> None:
    """Prints how well answers after messages are predicted if a table has answers before and after.
    The later answers of a third of these people are left out."""
    every, needed = pd.read_csv(path).fillna({"messages": ""}), table_of(path)[1]
    names = {"": "", **{skill: f"skill_{j}" for j, skill in enumerate(skills_of(path))}}
    joined = [";".join(names[m] for m in own.split(";")) for own in every["messages"]]
    told = every["messages"] != ""
    if needed is not None:
        every["messages"] = joined
    before = every[~told].pivot_table("label", "observer", "item")
    after = every[told].pivot_table("label", "observer", "item").reindex(before.index)
    taught, rows = after.dropna().index, dict[str, list[float]]()
    methods: dict[str, Callable[[Table, Table], Table]] = {
        "question's mean": lambda _, answers: mean(answers, None),
        "question x own earlier answer": own_earlier,
        "logistic, score": by_score,
    }
    for split in range(splits):
        chosen = np.random.default_rng((split, 2)).permutation(taught)[: len(taught) // 3]
        left = before.index.isin(chosen)
        answers = after.to_numpy(float, copy=True)
        answers[left] = np.nan
        labels = after.to_numpy()[left]
        for method, expected in methods.items():
            one = expected(before.to_numpy(), answers)[left]
            rows.setdefault(method, []).append(nats(one, labels, ~np.isnan(labels)))
        test = every[told & every["observer"].isin(chosen)]
        for way, known in {"discover": None, "discover, hypotheses": needed}.items():
            if way == "discover" or known is not None:
                with tempfile.TemporaryDirectory() as folder:
                    asked = test[["observer", "item", "messages"]]
                    p = predicted(every.drop(test.index), asked, known, Path(folder))
                given = np.ones(len(test), bool)
                rows.setdefault(way, []).append(nats(p, test["label"].to_numpy(), given))
    print(f"\n## {path.stem}, after messages: {len(taught)} people, a third left out\n")
    for way, values in rows.items():
        print(f"{way} | " + " | ".join(f"{v:.3f}" for v in (*values, np.mean(values))))


def worst(tenths: tuple[CalibrationBin, ...]) -> float:
    """Returns the largest difference in a tenth of the predictions."""
    return max(abs(one.said - one.ones) for one in tenths)


def examinees(banks: int, people: int) -> None:
    """Simulates an adaptive test with known slips and guesses. Each examinee has five random
    skills; a bank has 300 items with one to three skills each, and slips and guesses from 0.05 to
    0.15."""
    right: dict[int, list[bool]] = {5: [], 10: [], 15: []}
    until = []
    for bank in range(banks):
        rng = np.random.default_rng(bank)
        skills = [rng.choice(5, rng.integers(1, 4), replace=False) for _ in range(300)]
        needed = np.array([(1 << own).sum() for own in skills])
        labels = ((np.arange(32)[:, None] & needed) == 0).astype(np.uint8)
        slip, guess = rng.uniform(0.05, 0.15, (2, 300))
        test = Questionnaire(labels, 0.0, none=0.0, slip=slip, guess=guess, told=False)
        for person in range(people):
            lacked, questions, number, sure = (
                int(rng.integers(32)),
                test.restart(None, person),
                0,
                0,
            )
            while not sure or number < max(right):
                item, _ = questions.next()
                one = 1 - slip[item] if labels[lacked, item] else guess[item]
                questions.answer(int(rng.random() < one))
                number += 1
                if number in right:
                    right[number].append(questions.best == lacked)
                sure = sure or number * questions.done
            until.append(sure)
    print(f"{banks * people} examinees, 95 % intervals")
    for number, values in right.items():
        off = 1.96 * np.std(values) / len(values) ** 0.5
        print(f"profile right after {number} questions: {np.mean(values):.3f} ± {off:.3f}")
    off = 1.96 * np.std(until) / len(until) ** 0.5
    print(f"questions until a posterior of 0.95: {np.mean(until):.2f} ± {off:.2f}")


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="a folder of tables")
    parser.add_argument("--quick", action="store_true", help="simulated pupils, one split")
    parser.add_argument("--examinees", action="store_true", help="an adaptive test")
    given = parser.parse_args()
    if given.examinees or given.quick:
        examinees(*((1, 2) if given.quick else (10, 100)))
    if given.examinees:
        return
    if given.data is None:
        pupils, splits = (30, 1) if given.quick else (200, 3)
        compare("simulated pupils", *simulated(pupils), splits)
        return
    for path in sorted(given.data.glob("*.csv")):
        if path.stem.endswith("_items"):
            continue
        if "messages" in pd.read_csv(path, nrows=0) and pd.read_csv(path)["messages"].notna().any():
            after_teaching(path, 3)
        else:
            compare(path.stem, *table_of(path), 3)


if __name__ == "__main__":
    main()
