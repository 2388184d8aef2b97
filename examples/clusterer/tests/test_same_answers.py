from xplain.testing import Chosen, ClustererConformance


class TestSameAnswers(ClustererConformance):
    chosen = Chosen("clusterer", "same_answers", conf="conf")
