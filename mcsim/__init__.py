"""mcsim: is the isotropy violation that I measure made by my instrument?

Monte Carlo ensembles of isotropic skies seen through non-circular beams under a scan, their BipoSH coefficients and
power spectra, stored as xarray/Zarr. Names are loaded when they are first used, so that ``import mcsim`` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mcsim.diagnosis.api import diagnose
    from mcsim.ensemble.runner import merge, run
    from mcsim.ensemble.store import open_ensemble, open_summary
    from mcsim.errors import InputError

__all__ = ["InputError", "diagnose", "merge", "open_ensemble", "open_summary", "run"]

_HOME = {
    "InputError": "mcsim.errors",
    "diagnose": "mcsim.diagnosis.api",
    "merge": "mcsim.ensemble.runner",
    "open_ensemble": "mcsim.ensemble.store",
    "open_summary": "mcsim.ensemble.store",
    "run": "mcsim.ensemble.runner",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'mcsim' has no attribute {name!r}")
