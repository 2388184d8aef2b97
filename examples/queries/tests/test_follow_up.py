from xplain.testing import Chosen, QueriesConformance


class TestFollowUp(QueriesConformance):
    chosen = Chosen("queries", "follow_up", conf="conf")
