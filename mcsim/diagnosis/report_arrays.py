"""What a report shows besides the evidence: residual maps, candidates alone, explanations, simulations held out."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import healpy
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim.diagnosis.analysis import Proposal
from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.selection import Attribution, Explanation
from mcsim.diagnosis.verdict import effects_of
from mcsim.diagnosis.wiener_filter import Model, wiener_filter
from mcsim.errors import InputError
from mcsim.stats.gaussian import Fit, SimulatedGaussian, residual_pvalue

Map = NDArray[np.float64]

NSIDE = 16
"""Of residual maps, where the data are not coarser: finer pixels show noise and little else."""

TELLING = 12
"""Entries that are named where two explanations differ."""


def report_arrays(
    model: Model,
    maps: Sequence[Map],
    simulations: NDArray[np.float64],
    null: SimulatedGaussian,
    found: Attribution,
    candidates: Sequence[Candidate],
    proposals: Sequence[Proposal],
) -> xr.Dataset:
    """Pictures and fits as arrays, to be merged with the evidence.

    Parameters
    ----------
    model, maps
        What is believed, and the data.
    simulations, null
        Evidence of the model, shape (N, p_raw), and its null.
    found, candidates, proposals
        The verdict, and what it was chosen from.
    """
    alone = [_alone(index, single, candidates, proposals) for index, single in enumerate(found.singles)]
    return xr.Dataset(
        {
            "residual_map": (
                ("map", "pixel"),
                residual_maps(model, maps),
                {"long_name": "data less the sky that the maps share, over the noise of the pixel"},
            ),
            "alone": ("candidate", [row[0] for row in alone], {"long_name": "amplitude, fitted alone"}),
            "alone_sigma": ("candidate", [row[1] for row in alone], {"long_name": "standard error of it"}),
            "held_out": (
                "simulation",
                held_out(simulations, null),
                {"long_name": "probability of each simulation, judged by the others"},
            ),
        },
        coords={
            "map": _texts(part.name for part in model.parts),
            "candidate": _texts(proposal.label for proposal in proposals),
            "unit": ("candidate", _texts(proposal.kind.unit for proposal in proposals)),
        },
        attrs={
            "frame": model.survey.config.map.frame,
            "explanations": json.dumps([_explanation(one) for one in found.explanations]),
            "contrasts": json.dumps(
                [
                    {
                        "first": one.first,
                        "second": one.second,
                        "separation": one.separation,
                        "entries": one.elements[:TELLING].tolist(),
                        "shares": one.shares[:TELLING].tolist(),
                    }
                    for one in found.contrasts
                ]
            ),
        },
    )


def residual_maps(model: Model, maps: Sequence[Map]) -> Map:
    """Residual of every map over its noise in coarse pixels, shape (map, 12 nside^2); NaN where nothing was seen.

    Notes
    -----
    sum N^-1 (d - P s^) / sqrt(sum N^-1) over the pixels in a coarse one. The sky s^ has taken up some of the noise, so
    that without a gap the rms is a little less than 1.
    """
    nside = min(NSIDE, model.nside)
    fine = np.arange(12 * model.nside**2)
    coarse = healpy.ring2nest(model.nside, fine) // (model.nside // nside) ** 2
    coarse = healpy.nest2ring(nside, coarse)
    filtered = wiener_filter(model, maps)
    rows = []
    for residual, part in zip(filtered.residual, model.parts, strict=True):
        total = np.bincount(coarse, weights=residual, minlength=12 * nside**2)
        weight = np.bincount(coarse, weights=np.where(residual != 0.0, part.precision, 0.0), minlength=12 * nside**2)
        seen = weight > 0.0
        rows.append(np.where(seen, total / np.sqrt(np.where(seen, weight, 1.0)), np.nan))
    return np.stack(rows)


def held_out(simulations: NDArray[np.float64], null: SimulatedGaussian) -> NDArray[np.float64]:
    """Omnibus probability of every simulation against all others, shape (N,): uniform where the evidence is Gaussian.

    Notes
    -----
    With c = x_i - mean, S the scatter of all N and a = N/(N - 1) c'S^-1 c, the scatter of the others is
    S - N/(N - 1) c c', and x_i less their mean is N/(N - 1) c: its square in their scatter, over 1 + 1/(N - 1), is
    a/(1 - a) (Sherman & Morrison, Ann. Math. Stat. 21, 124, 1950).
    Against explicit refits: tests/unit/test_diagnosis_report.py.
    """
    count = len(simulations)
    white = (simulations - simulations.mean(axis=0)) @ null.whitening.T
    a = np.sum(white**2, axis=1) / null.dof * count / (count - 1)
    square = (null.dof - 1) * a / np.maximum(1.0 - a, 1e-12)
    return residual_pvalue(square, null.dimension, null.dof - 1)


def _texts(words: Iterable[str]) -> NDArray[np.object_]:
    """As objects: Zarr 3 has no stable form for numpy's texts of fixed length."""
    return np.array(list(words), dtype=object)


def _alone(
    index: int, single: Fit, candidates: Sequence[Candidate], proposals: Sequence[Proposal]
) -> tuple[float, float]:
    """Amplitude and standard error of a candidate; NaN where no effect has such an amplitude."""
    try:
        (effect,) = effects_of(Explanation((index,), single, 1.0, single.pvalue, single.pvalue), candidates, proposals)
    except InputError:
        return float("nan"), float("nan")
    return effect["amplitude"], effect["sigma"]


def _explanation(one: Explanation) -> dict[str, Any]:
    return {
        "members": list(one.members),
        "amplitudes": one.fit.amplitudes.tolist(),
        "odds": one.odds,
        "probability": one.pvalue,
        "further": one.further,
        "chi2": one.fit.chi2,
        "dimension": one.fit.dimension,
    }
