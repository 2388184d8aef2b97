from xplain.testing import Chosen, SolverConformance


class TestDualMode(SolverConformance):
    chosen = Chosen("solver", "dual_mode", conf="conf")
