"""Tell whether a measured isotropy violation is made by the instrument, and what a simulation of it lacks.

Monte Carlo ensembles of isotropic skies seen through non-circular beams under a scan, their bipolar spherical harmonic
(BipoSH) coefficients and power spectra, stored as xarray/Zarr; their prediction without Monte Carlo; and a diagnosis of
the difference between simulations and maps. Temperatures are in uK_CMB, a_lm in healpy's m-major order, pixels in RING
order.

Ensembles: `run`, `merge`, `open_ensemble`, `open_summary`; configurations: `load_config`, `RunConfig`.
Instrument: `Beam`, `ScanModel`, `Moments`, and what they make of one sky: `observe`.
Statistics: `biposh` of maps at hand, `predict` of a run, `fit` of an effective beam, `prepare` and `diagnose` of maps
with `DiagnosisSettings`, also by the simulator of another program, an `ExternalModel`; `limit` of what maps can tell
with `LimitSettings`, `compare` of two simulations.
Systematic effects: `effects`, and `Effect` to write one. Bad input raises `InputError`, and what could not go
on for another reason `RunError`.

Names are loaded when they are first used, so that ``import mcsim`` costs little.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mcsim.beamfit.api import fit
    from mcsim.bipolar.dataset import biposh
    from mcsim.comparison.api import compare
    from mcsim.config import RunConfig
    from mcsim.config import load as load_config
    from mcsim.datavector.settings import DiagnosisSettings
    from mcsim.diagnosis.api import diagnose
    from mcsim.ensemble.external import ExternalModel
    from mcsim.ensemble.maps import write_maps
    from mcsim.ensemble.opening import open_ensemble, open_summary
    from mcsim.ensemble.prediction import predict
    from mcsim.ensemble.prepare import prepare
    from mcsim.ensemble.runner import merge, run
    from mcsim.errors import InputError, RunError
    from mcsim.information.api import limit
    from mcsim.information.settings import LimitSettings
    from mcsim.instrument.beams import Beam
    from mcsim.instrument.scan import Moments, ScanModel
    from mcsim.simulation.observe import observe
    from mcsim.systematics import Effect, effects

    __version__: str

__all__ = [
    "Beam",
    "DiagnosisSettings",
    "Effect",
    "ExternalModel",
    "InputError",
    "LimitSettings",
    "Moments",
    "RunConfig",
    "RunError",
    "ScanModel",
    "__version__",
    "biposh",
    "compare",
    "diagnose",
    "effects",
    "fit",
    "limit",
    "load_config",
    "merge",
    "observe",
    "open_ensemble",
    "open_summary",
    "predict",
    "prepare",
    "run",
    "write_maps",
]

_HOME = {
    "Beam": "mcsim.instrument.beams",
    "DiagnosisSettings": "mcsim.datavector.settings",
    "Effect": "mcsim.systematics",
    "ExternalModel": "mcsim.ensemble.external",
    "InputError": "mcsim.errors",
    "LimitSettings": "mcsim.information.settings",
    "Moments": "mcsim.instrument.scan",
    "RunConfig": "mcsim.config",
    "RunError": "mcsim.errors",
    "ScanModel": "mcsim.instrument.scan",
    "biposh": "mcsim.bipolar.dataset",
    "compare": "mcsim.comparison.api",
    "diagnose": "mcsim.diagnosis.api",
    "effects": "mcsim.systematics",
    "fit": "mcsim.beamfit.api",
    "limit": "mcsim.information.api",
    "load_config": "mcsim.config:load",
    "merge": "mcsim.ensemble.runner",
    "observe": "mcsim.simulation.observe",
    "open_ensemble": "mcsim.ensemble.opening",
    "open_summary": "mcsim.ensemble.opening",
    "predict": "mcsim.ensemble.prediction",
    "prepare": "mcsim.ensemble.prepare",
    "run": "mcsim.ensemble.runner",
    "write_maps": "mcsim.ensemble.maps",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("mcsim")
    if name in _HOME:
        module, _, own = _HOME[name].partition(":")
        return getattr(import_module(module), own or name)
    raise AttributeError(f"module 'mcsim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
