from xplain.testing import Chosen, ClustererConformance


class TestSameAnswers(ClustererConformance):
    component = Chosen("clusterer", "same_answers", conf="conf")
