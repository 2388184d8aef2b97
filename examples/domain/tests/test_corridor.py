from xplain.testing import Chosen, DomainConformance


class TestCorridor(DomainConformance):
    chosen = Chosen("domain", "corridor", conf="conf")
