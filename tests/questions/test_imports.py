"""The questionnaire needs only numpy, scipy and numba."""

import subprocess
import sys

from tests.conftest import ROOT

PROGRAM = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pandas", "sklearn", "hydra", "omegaconf", "mlflow"):
            raise ImportError(name)

sys.meta_path.insert(0, Refused())
from xplain import Hypotheses, Questionnaire

q = Questionnaire([[1, 1], [0, 1], [1, 0], [0, 0]])
transition, told = q.next()
q.answer(0)
print(q.posterior.sum() + q.none)
"""


def test_it_needs_no_more_than_numpy_scipy_and_numba():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert abs(float(done.stdout) - 1) < 1e-9
