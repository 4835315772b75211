"""A beam that keeps its orientation in the model while the scan turns it."""

from dataclasses import dataclass, replace

import numpy as np

from mcsim.instrument.scan import MapGrid, Moments, ScanModel, cached_moments
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization


@dataclass(frozen=True, kw_only=True)
class OrientationAveraging(Effect):
    """Orientation moments (1 - amplitude) w + amplitude w of the real scan; at 1 all of the real scan's.

    Attributes
    ----------
    model
        A packaged scan model, or the path of one, that stands for the real scan; left out, it is the scan that the
        channel's pointing is known from. A diagnosis of a run with parallel transport proposes WMAP's.

    Notes
    -----
    The real moments are those of the model's whole survey, in every split. Hits and centroids stay those of the model.
    """

    name = "orientation_averaging"
    scope = "channel"
    unit = "1 = parallel transport assumed, scan real"
    title = "orientations of the scan"
    wording = Wording("{} of the step from parallel transport to the real scan", " %", 100.0)
    cause = "Parallel transport, or one orientation per pixel, in place of the survey's samples."
    signature = "L = 2, M = 0 falls to 0.66 of what parallel transport gives, and other M appear."
    source = "Joshi et al. arXiv:1210.7318, Sec. VI and last appendix"
    step = 0.05
    bounds = (
        Bound("amplitude", 0.0, 1.25, "0 is the model and 1 the real scan; a quarter more for errors of the latter"),
    )
    parametrization = Parametrization(sign=1)
    variants = ({"model": "wmap"},)

    model: str = ""

    def orientations(self, moments: Moments, site: Site) -> Moments:
        """Mix the moments; pixels that the real scan does not reach stay as they are."""
        if self.amplitude == 0.0:
            return moments
        if self.model:
            real = ScanModel.load(self.model)
        else:
            pointed = site.pointed(self.name)
            real = pointed.model.with_lines_of_sight(pointed.line.name)
        other = Moments.load(cached_moments(real, MapGrid(moments.nside, moments.frame), moments.smax))
        mixed = (1.0 - self.amplitude) * moments.w + self.amplitude * other.w
        return replace(moments, w=np.where(other.hits > 0.0, mixed, moments.w))
