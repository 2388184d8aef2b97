from xplain.testing import Chosen, TypeFinderConformance


class TestSameAnswers(TypeFinderConformance):
    chosen = Chosen("clusterer", "same_answers", conf="conf")
