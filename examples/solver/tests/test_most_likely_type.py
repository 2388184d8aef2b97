from xplain.testing import Chosen, SolverConformance


class TestMostLikelyType(SolverConformance):
    chosen = Chosen("solver", "most_likely_type", conf="conf")
