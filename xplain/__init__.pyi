from xplain.domains.users.hypotheses import Hypotheses as Hypotheses
from xplain.interaction.explainer import Explainer as Explainer
from xplain.interaction.explainer import GivenTypes as GivenTypes
from xplain.learning.saved_types import LearnedTypes as LearnedTypes
from xplain.questions.questionnaire import Questionnaire as Questionnaire
from xplain.runs.api import Run as Run
from xplain.runs.api import Sweep as Sweep
from xplain.runs.api import load as load
from xplain.runs.api import run as run
from xplain.runs.api import sweep as sweep

__version__: str
