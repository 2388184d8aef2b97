from xplain.testing import Chosen, TypeSourceConformance


class TestOneFactEach(TypeSourceConformance):
    chosen = Chosen("users", "one_fact_each", conf="conf")
