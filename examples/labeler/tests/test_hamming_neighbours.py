from xplain.testing import Chosen, LabelerConformance


class TestHammingNeighbours(LabelerConformance):
    chosen = Chosen("labeler", "hamming_neighbours", conf="conf")
