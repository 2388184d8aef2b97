from xplain.testing import Chosen, DomainConformance


class TestWarehouse(DomainConformance):
    chosen = Chosen("domain", "warehouse", conf="conf")
