"""Test if mcsim's own simulation of a model agrees with that of somebody else."""

import numpy as np
from scipy.stats import ks_2samp

from mcsim.datavector.candidate import lost, parts_of
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.result import Agreement
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import global_test
from mcsim.support.arrays import Vector
from mcsim.systematics import described, if_possible


def agreement(known: DiagnosisContext) -> Agreement:
    """Test if mcsim's own simulation of the description is one of the external ensemble.

    Notes
    -----
    The skies in which responses are measured are diagnosed with the external ensemble as the model: their mean with all
    candidates, as the data of a table are (:meth:`NullEnsemble.of_mean`), and the scatter of their chi^2 against those
    of the external simulations (each against the others, Kolmogorov-Smirnov). The smaller of both p-values counts,
    corrected by Šidák. Where the pointing is known, mcsim's skies are those of the default route or of the time-ordered
    reference, whichever agrees better: an external simulator may be either.
    """
    ensemble, source = known.ensemble, known.analysis.source
    assert source is not None
    null = ensemble.of_mean(len(ensemble.reference)).gaussian
    groups = null.whiten_groups(known.templates, [one.columns for one in known.candidates])
    others, found = ensemble.held_out_pvalues(known.null), []
    offset = np.zeros(len(null.mean)) if ensemble.own_offset is None else ensemble.own_offset
    for shift in [offset, 0.0 * offset][: 1 + int(offset.any())]:
        own = ensemble.reference + shift
        mean = own.mean(axis=0)
        test = global_test(null, mean, groups, known.calibration)
        scatter = float(ks_2samp([known.null.pvalue(x) for x in own], others).pvalue)
        least = min(test.pvalue, scatter, 1.0 - 1e-12)
        found.append((float(-np.expm1(2.0 * np.log1p(-least))), mean))
    pvalue, mean = max(found, key=lambda one: one[0])
    nearest = _nearest(known, null, 2.0 * null.mean - mean)  # what the external simulations have and mcsim's lack
    accepted = tuple(name for name in source.effects if name in {one.name for one in known.candidates})
    level = known.settings.agreement_level
    return Agreement(source.label, pvalue, pvalue > level, len(ensemble.reference), nearest, accepted)


def _nearest(known: DiagnosisContext, null: SimulatedGaussian, there: Vector) -> str:
    """Return the candidate that describes a data vector, shape (p,), best with an amplitude that it can have, and that.

    A fall of chi^2 counts as far as such an amplitude has it: less power is not that of point sources.
    """
    candidates, chi2 = known.candidates, null.chi2(there)
    fits = [null.fit(there, known.templates[:, list(one.columns)]) for one in candidates]
    falls = [fit.delta_chi2 - lost(candidates, (k,), fit, null.dof) for k, fit in enumerate(fits)]
    pvalues = null.nested_test(np.maximum(falls, 0.0), chi2, [len(one.columns) for one in candidates])
    best = int(np.lexsort((-np.array(falls), pvalues))[0])
    ((_, theta, covariance),) = parts_of(candidates, (best,), fits[best])
    with if_possible():
        # From responses to small steps: without an error, which a large one has beyond that of the noise.
        about = described(candidates[best].fitted(theta, covariance), known.frame)
        return f"{candidates[best].title} (about {about})"
    return candidates[best].title
