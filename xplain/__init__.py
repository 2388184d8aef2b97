"""Personalized explanations of sequential decisions (Soni, Sreedharan & Kambhampati, 2021).

These names and the names of ``xplain.testing`` are public: they do not change without notice.
Everything else may change. docs/explainer.md describes explanations in a program, docs/python.md
describes experiments, and docs/your-own-domain.md describes new components.
"""

from typing import Any

__version__ = "0.1.0"

_WHERE = {
    **dict.fromkeys(("Domain", "Item", "Parameter", "Scene"), "xplain.domains.base"),
    "MDP": "xplain.domains.mdp",
    "Hypotheses": "xplain.domains.users.hypotheses",
    **dict.fromkeys(("Setting", "UserType"), "xplain.domains.users.setting"),
    "TypeSource": "xplain.domains.users.types",
    **dict.fromkeys(("InputError", "TooLargeError"), "xplain.errors"),
    **dict.fromkeys(("Limits", "Question"), "xplain.explanation.asking"),
    **dict.fromkeys(("BeliefUpdate", "Independent", "Persistent"), "xplain.explanation.belief"),
    "LabelTable": "xplain.explanation.label_table",
    "Problem": "xplain.explanation.problem",
    **dict.fromkeys(("Reaction", "SimulatedUser"), "xplain.interaction.explainees"),
    **dict.fromkeys(("Explainer", "GivenTypes"), "xplain.interaction.explainer"),
    "Session": "xplain.interaction.session",
    "Clusterer": "xplain.learning.user_types",
    "Clustering": "xplain.learning.types",
    "Dataset": "xplain.learning.data.dataset",
    **dict.fromkeys(("Answer", "Queries"), "xplain.learning.data.queries"),
    "LabelerTrainer": "xplain.learning.labelers",
    "LearnedTypes": "xplain.learning.saved",
    "Questionnaire": "xplain.questions.questionnaire",
    "stream": "xplain.randomness",
    **dict.fromkeys(("Run", "Sweep", "discover", "load", "run", "sweep"), "xplain.runs.api"),
    **dict.fromkeys(("Policy", "Solver"), "xplain.solvers.base"),
}
__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    # Imported on demand: `python -m xplain --help` must not wait for numba. Type checkers
    # read __init__.pyi.
    if name not in _WHERE:
        raise AttributeError(f"module 'xplain' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return __all__
