from xplain.testing import Chosen, ExplaineeConformance


class TestPolite(ExplaineeConformance):
    chosen = Chosen("explainee", "polite", conf="conf")
