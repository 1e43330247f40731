"""Ways to damage what users and other people give: mapping files, logs, models, results; each a function of a Random.

Every kind takes a `random.Random`, so that a benchmark may draw from a seed and a property test from its own choices.
"""

from damage.case import Case, healthy
from damage.fits import FITS
from damage.logs import LOGS
from damage.mappings import MAPPINGS
from damage.models import MODELS
from damage.options import OPTIONS

# What is checked and fitted: damage to the inputs of `check` and `close-loop`.
INPUTS = MAPPINGS | LOGS | MODELS

__all__ = ["FITS", "INPUTS", "LOGS", "MAPPINGS", "MODELS", "OPTIONS", "Case", "healthy"]
