from xplain.testing import Chosen, DomainConformance


class TestGreenhouse(DomainConformance):
    chosen = Chosen("domain", "greenhouse", conf="conf")
