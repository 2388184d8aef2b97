from xplain.testing import Chosen, DomainConformance


class TestGreenhouse(DomainConformance):
    component = Chosen("domain", "greenhouse", conf="conf")
