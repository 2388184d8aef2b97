"""Test suites for your own components. Three lines test a package::

    from xplain.testing import Chosen, SolverConformance
    class TestMine(SolverConformance):
        chosen = Chosen("solver", "mine", conf="conf")

``chosen`` is a component from a YAML file, as on the command line. To test one or more objects of
your own, override the fixture::

    class TestMine(SolverConformance):
        @pytest.fixture(params=[Mine(depth=1), Mine(depth=9)])
        def component(self, request):
            return request.param

Run them with pytest. Each test checks a property that other parts of xplain need.
"""

from typing import Any

_WHERE = {
    "Chosen": "chosen",
    "TypeFinderConformance": "clusterer",
    "DomainConformance": "domain",
    "ExplaineeConformance": "explainee",
    "LabelerConformance": "labeler",
    "PartitionConformance": "clusterer",
    "QueriesConformance": "queries",
    "SolverConformance": "solver",
    "TypeSourceConformance": "types",
}
__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    # Suites are imported on demand, because the data sets and problems need no pytest. Type
    # checkers read __init__.pyi.
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    try:
        return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)
    except ModuleNotFoundError as error:
        if error.name != "pytest":
            raise
        raise ImportError(f"xplain.testing.{name} needs pytest: pip install pytest") from None


def __dir__() -> list[str]:
    return __all__
