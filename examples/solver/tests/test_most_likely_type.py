from xplain.testing import Chosen, SolverConformance


class TestMostLikelyType(SolverConformance):
    component = Chosen("solver", "most_likely_type", conf="conf")
