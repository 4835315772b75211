"""Diagnose with the simulator of somebody else: the model, its batch, and if mcsim's own simulation agrees with it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ks_2samp

from mcsim import config
from mcsim.datavector.candidate import parts_of
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.result import Agreement
from mcsim.ensemble.external import named_source, source_of
from mcsim.ensemble.external_maps import Source
from mcsim.errors import InputError
from mcsim.stats.look_elsewhere import global_test


@dataclass(frozen=True, eq=False)
class ExternalModel:
    """A model whose maps another program simulates.

    Parameters
    ----------
    description
        Sky, beams, scans and noise of the instrument: a run. With it maps are filtered, and the responses to effects
        that the other program cannot add are simulated.
    simulator
        Where the maps come from. A function ``simulate(seed, effects=())``, or an object with such a method, or its
        class (made with the description if it takes an argument), or ``"package.module:name"`` of these: it returns
        maps, uK, RING order, in the description's frame and after its preparation, as a dict or xarray object by
        channel, or by channel and split. Or stored maps: the template of FITS files with {realization}, {channel} and
        {split}; a Zarr store; an xarray object or array with the dimension ``realization``.

    Notes
    -----
    A simulator has the attribute ``effects``, names of the effects that it can add, if there are any: it is then called
    with a tuple of :class:`mcsim.config.Effect`, each with ``name``, ``channel`` and ``parameters``. With a keyword
    ``sky`` it is given coefficients a_lm, uK, in place of a sky of its own. An attribute ``state`` stands for what it
    depends on besides its source code; default: all that the object holds.

    Examples
    --------
    >>> import healpy, numpy as np
    >>> import mcsim
    >>> def white(seed):
    ...     return {"demo": np.random.default_rng(seed).normal(scale=50.0, size=healpy.nside2npix(16))}
    >>> mcsim.ExternalModel("tiny", white).description
    'tiny'
    """

    description: str | Path | Mapping[str, Any] | config.RunConfig
    simulator: Any


def loaded(
    model: str | Path | Mapping[str, Any] | config.RunConfig | ExternalModel,
) -> tuple[config.RunConfig, Source | None]:
    """Return the run that a model is or that describes it, and its source of maps; None: mcsim itself."""
    given = model.description if isinstance(model, ExternalModel) else model
    run = config.load(given)
    bare, named = named_source(run)
    if isinstance(model, ExternalModel):
        if named is not None:
            raise InputError(f"{run.name} names the simulator {named!r} already; give the run or the simulator alone.")
        return bare, source_of(bare, model.simulator)
    return bare, None if named is None else source_of(bare, named)


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
        nearest += f" (about {found_there.describe()})"
    except InputError:
        pass
    accepted = tuple(name for name in source.effects if name in {one.name for one in known.candidates})
    level = known.settings.agreement_level
    return Agreement(source.label, pvalue, pvalue > level, len(ensemble.reference), nearest, accepted)
