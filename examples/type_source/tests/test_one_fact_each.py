from xplain.testing import Chosen, TypeSourceConformance


class TestOneFactEach(TypeSourceConformance):
    component = Chosen("users", "one_fact_each", conf="conf")
