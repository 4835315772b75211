"""Why an effect cannot be there, or would change nothing."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mcsim import config, systematics
from mcsim.datavector.filter_model import Model
from mcsim.errors import InputError
from mcsim.simulation.channels import refuse_unseen
from mcsim.simulation.survey import Channel
from mcsim.simulation.timestream import CorrelatedNoise
from mcsim.systematics import Effect, acts_through
from mcsim.systematics.hooks import HOOKS


def hindrance(model: Model, kind: type[Effect], channel: str | None, settings: Mapping[str, Any]) -> str | None:
    """Return why an effect cannot be there, or would change nothing; None if it can be there.

    HookError for one whose hooks fail.
    """
    owners = [c for c in model.survey.channels if channel in (None, c.name)]
    if acts_through(kind, "differencing") and any(owner.side_b is None for owner in owners):
        return "it acts on differencing, and the scan has none"
    if acts_through(kind, "excess", "steady_gain") and any(owner.side_b is not None for owner in owners):
        return "it acts on the samples of one beam, and the scan takes differences of two"
    made = [c for c in model.survey.making.channels if channel in (None, c.name)]
    if [hook for hook in HOOKS if acts_through(kind, hook)] == ["spread"] and all(map(_centred, made)):
        return "it moves samples within their pixels, and those of the maps are at the centres"
    drawn = [m.drawn for owner in owners for m in owner.maps]
    if acts_through(kind, "knee") and not all(isinstance(one, CorrelatedNoise) for one in drawn):
        return "it moves the knee of noise with memory, and that of the maps has none"
    if acts_through(kind, "orientations"):
        scans = [spec.scan for spec in model.survey.config.channels if channel in (None, spec.name)]
        if not all(isinstance(scan, config.ScanParallelTransport) for scan in scans):
            return "it acts on the orientations of parallel transport, and the scan has its own"
        if not any(owner.beam.mmax for owner in owners):
            return "it acts on orientations, which a circular beam does not show"
    effect = systematics.basis_of(kind, settings)[0]
    try:
        for owner in owners:
            systematics.tried((effect,), replace(owner.site, lmax=model.lmax))
            effect.orientations(owner.maps[0].moments, owner.site)
            refuse_unseen(owner.name, (effect,))
    except systematics.HookError:
        raise
    except InputError as error:
        return str(error).rstrip(".")
    quiet = all(m.noise_uk is None for owner in owners for m in owner.maps)
    if quiet and acts_through(kind, "noise", "excess"):
        return "it acts on noise, and the maps have none"
    return None


def _centred(channel: Channel) -> bool:
    """Return True if the samples of a channel are at the centres of their pixels, which have no window then."""
    return bool(np.all(channel.window == 1.0)) and all(m.moments.dtheta is None for m in channel.maps)
