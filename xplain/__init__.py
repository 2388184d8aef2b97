"""Personalized explanations of sequential decisions (Soni, Sreedharan & Kambhampati, 2021).

For programs: ``from xplain import Explainer, GivenTypes, LearnedTypes`` (see docs/explainer.md),
``from xplain import Hypotheses, Questionnaire`` (see docs/what-to-ask.md). Experiments:
``xplain.run``, ``xplain.sweep``, ``xplain.load`` (see docs/python.md).
"""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"

_WHERE = {
    "Explainer": "xplain.interaction.explainer",
    "GivenTypes": "xplain.interaction.explainer",
    "Hypotheses": "xplain.domains.users.hypotheses",
    "LearnedTypes": "xplain.learning.saved_types",
    "Questionnaire": "xplain.questions.questionnaire",
    **dict.fromkeys(("Run", "Sweep", "load", "run", "sweep"), "xplain.runs.api"),
}
__all__ = sorted(["__version__", *_WHERE])


def __getattr__(name: str) -> Any:
    # Imported when asked for: `python -m xplain --help` must not wait for numba. What each name is
    # for type checkers, __init__.pyi says.
    if name not in _WHERE:
        raise AttributeError(f"module 'xplain' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return __all__
