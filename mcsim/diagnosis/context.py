"""What every case of a model is diagnosed with."""

from dataclasses import dataclass

from mcsim import config
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.knowledge import Knowledge
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import Calibration


@dataclass(frozen=True)
class DiagnosisContext:
    """What every case of a model is diagnosed with.

    Attributes
    ----------
    run, analysis, known
        The model, what is measured and proposed, and what its simulations gave.
    null
        Distribution of the whole data vector under the model.
    candidates, calibration
        Of the proposals.
    """

    run: config.RunConfig
    analysis: Analysis
    known: Knowledge
    null: SimulatedGaussian
    candidates: tuple[Candidate, ...]
    calibration: Calibration
