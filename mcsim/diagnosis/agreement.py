"""Test if mcsim's own simulation of a model agrees with that of somebody else."""

import numpy as np
from scipy.stats import ks_2samp

from mcsim.datavector.candidate import parts_of
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.result import Agreement
from mcsim.errors import InputError
from mcsim.stats.look_elsewhere import global_test
from mcsim.systematics import described


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
        found.append((float(-np.expm1(2.0 * np.log1p(-least))), test.best, mean))
    pvalue, best, mean = max(found, key=lambda one: one[0])
    # What the external simulations have and mcsim's lack.
    there = 2.0 * null.mean - mean
    fit = null.fit(there, known.templates[:, list(known.candidates[best].columns)])
    nearest = known.candidates[best].title
    try:
        ((_, theta, covariance),) = parts_of(known.candidates, (best,), fit)
        found_there = known.candidates[best].fitted(theta, covariance)
        # From responses to small steps: without an error, which a large one has beyond that of the noise.
        nearest += f" (about {described(found_there, known.frame)})"
    except InputError:
        pass
    accepted = tuple(name for name in source.effects if name in {one.name for one in known.candidates})
    level = known.settings.agreement_level
    return Agreement(source.label, pvalue, pvalue > level, len(ensemble.reference), nearest, accepted)
