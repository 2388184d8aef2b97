"""Plots of what was found in people's labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from xplain.explanation.message_sets import bits_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.prediction import Tenth
from xplain.learning.types import Clustering
from xplain.report.plots import COLOURS, MARKERS


def posterior(probability: Mapping[int, float], found: int) -> Figure:
    """P(number of types | labels), the number that was taken in another colour and hatched."""
    figure = Figure(figsize=(5, 3.2))
    axes = figure.subplots()
    numbers = np.arange(1, max(*probability, found) + 2)
    heights = [probability.get(int(k), 0.0) for k in numbers]
    bars = axes.bar(numbers, heights, color=COLOURS[5], edgecolor="black")
    bars[found - 1].set(facecolor=COLOURS[0], hatch="//", edgecolor="white")
    axes.set(
        xlabel="number of user types",
        ylabel="posterior probability",
        title=f"{found} types taken (hatched)",
        ylim=(0, 1),
    )
    axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
    return figure


def effects(dataset: Dataset, clustering: Clustering, names: Sequence[str]) -> Figure:
    """How much likelier a label is 1 where a message was given, by type and message."""
    gain = np.array([_gain(dataset.of(clustering.members(t))) for t in range(clustering.n_types)])
    height = 1.6 + 0.32 * len(gain)
    figure = Figure(figsize=(2.5 + 0.75 * gain.shape[1], height))
    axes = figure.subplots()
    image = axes.imshow(gain, cmap="PuOr", vmin=-0.5, vmax=0.5, aspect="auto")
    axes.set_xticks(range(gain.shape[1]), dataset.messages, rotation=30, ha="right")
    axes.set_yticks(range(len(gain)), list(names)[: len(gain)])
    axes.grid(False)
    if gain.size <= 400:
        for (t, j), value in np.ndenumerate(gain):
            ink = "white" if abs(value) > 0.35 else "black"
            axes.text(j, t, f"{100 * value:+.0f}", ha="center", va="center", color=ink, fontsize=8)
    axes.set(xlabel="message", title="Explicable labels: given − not given (percentage points)")
    figure.colorbar(image, ax=axes, label="difference of shares")
    return figure


def calibration(tenths: Sequence[Tenth]) -> Figure:
    """How many of the held-out labels are 1, by how likely that was said to be, with intervals."""
    figure = Figure(figsize=(4, 3.8))
    axes = figure.subplots()
    said, ones = np.array([one.said for one in tenths]), np.array([one.ones for one in tenths])
    ends = np.array([[one.ones - one.low, one.high - one.ones] for one in tenths]).T
    axes.plot([0, 1], [0, 1], color=COLOURS[6], linewidth=1, label="as said")
    axes.errorbar(
        *(said, ones, ends.clip(0)),
        color=COLOURS[0],
        marker=MARKERS[0],
        linestyle="none",
        capsize=3,
        label=f"{len(tenths)} parts of {min(one.labels for one in tenths)} labels or more",
    )
    axes.set(
        xlabel="probability of label 1, as predicted",
        ylabel="share of labels 1 (95 % interval)",
        title="Calibration on held-out labels",
        xlim=(-0.02, 1.02),
        ylim=(-0.02, 1.02),
    )
    axes.set_aspect("equal")
    axes.legend(loc="upper left", fontsize=8)
    return figure


def _gain(dataset: Dataset) -> NDArray[np.float64]:
    """[n] share of ones with the message less without; 0 where either was never asked."""
    given = bits_of(dataset.message_set, dataset.n_messages).astype(bool)
    result = np.zeros(dataset.n_messages)
    for j in range(dataset.n_messages):
        told, untold = dataset.label[given[:, j]], dataset.label[~given[:, j]]
        if len(told) and len(untold):
            result[j] = told.mean() - untold.mean()
    return result
