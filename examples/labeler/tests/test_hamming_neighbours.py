from xplain.testing import Chosen, LabelerConformance


class TestHammingNeighbours(LabelerConformance):
    component = Chosen("labeler", "hamming_neighbours", conf="conf")
