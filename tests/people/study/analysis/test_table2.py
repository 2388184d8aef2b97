"""Compares Table 2 from people's data with scipy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.people.study.analysis.completed import completed
from xplain.errors import InputError
from xplain.people.study.analysis import analyse as analysis_of
from xplain.people.study.analysis import paper_table, read


def test_the_table_is_what_scipy_computes_from_people_alone() -> None:
    from scipy import stats

    data = completed(20)
    found = analysis_of(data, "person", {"conformant3": "was interrupted"})
    assert found.flow.loc["excluded: was interrupted", "all"] == 1
    assert found.flow.loc["analysed", "all"] == len(found.data)
    own = data[(data["stream"] == "person") & (data["participant"] != "conformant3")]
    for measure, row in found.measures.iterrows():
        a, b = (own.loc[own["condition"] == c, measure] for c in ("conformant", "personalized"))
        student, welch = stats.ttest_ind(a, b), stats.ttest_ind(a, b, equal_var=False)
        assert row["student_p"] == pytest.approx(student.pvalue)
        assert row["student_df"] == 37
        assert row["welch_p"] == pytest.approx(welch.pvalue)
        assert (row["n_conformant"], row["n_personalized"]) == (19, 20)
        assert row["mean_conformant"] == pytest.approx(a.mean())
    assert list(found.measures.index)[:3] == list(paper_table())
    with pytest.raises(InputError, match="exclude"):
        analysis_of(data, "person", {"nobody": "x"})
    with pytest.raises(InputError, match="stream"):
        analysis_of(data, "people", {})


@pytest.mark.parametrize("n", [0, 1, 2])
def test_small_studies_are_analysed_or_refused(n: int, tmp_path: Path) -> None:
    data = completed(n + 1).iloc[: 2 * n] if n < 2 else completed(n)
    data.assign(interaction_time_s=5.0).to_csv(tmp_path / "participants.csv", index=False)
    if n < 2:
        with pytest.raises(InputError):
            analysis_of(read(tmp_path), "person", {})
    else:  # no spread in time: no t test, but no failure
        found = analysis_of(read(tmp_path), "person", {})
        time = found.measures.loc["interaction_time_s"]
        assert np.isnan(time["student_p"])
        assert time["permutation_p"] == 1


def test_who_has_no_possible_time_counts_in_every_other_measure() -> None:
    data = completed(6)
    whose = data.index[(data["condition"] == "conformant") & (data["stream"] == "person")][0]
    data.loc[whose, "interaction_time_s"] = np.nan
    found = analysis_of(data, "person", {})
    time, inexplicable = (found.measures.iloc[row] for row in (0, 1))
    assert (time["n_conformant"], inexplicable["n_conformant"]) == (5, 6)
    assert not np.isnan(time["student_p"])
    assert found.flow.loc["time left out: the clock was set back", "all"] == 1


def test_files_that_are_no_export_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"participants\.csv"):
        read(tmp_path)
    (tmp_path / "participants.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="lacks the column participant"):
        read(tmp_path)
