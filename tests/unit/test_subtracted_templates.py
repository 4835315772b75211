"""What a preparation fits and subtracts, as the filters of prepared maps know it."""

import healpy
import numpy as np

from instruments import two_channels
from mcsim import config
from mcsim.simulation.preparation import preparation

NSIDE = 16
XYZ = np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
FIT, MASK = (np.where(np.abs(XYZ[2]) > height, 1.0, 0.0) for height in (0.2, 0.5))


def test_templates_are_those_that_later_steps_leave():
    """A fit is followed by a mask: the templates of its maps are masked, and so is the weight of the fit."""
    steps = [{"kind": "subtract_dipole", "mask": FIT}, {"kind": "mask", "mask": MASK}]
    run = config.load(two_channels("subtracted", lmax=24) | {"preparation": steps})
    made = preparation(run, run.channels[0], "half1")
    assert made is not None
    [(columns, weight)] = made.regressions()
    np.testing.assert_allclose(columns, MASK * np.stack([np.ones(XYZ.shape[1]), *XYZ]), atol=1e-12)
    np.testing.assert_array_equal(weight, FIT * MASK)
