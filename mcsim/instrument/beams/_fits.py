"""Opening FITS so that a truncated file is an error rather than a warning, and is closed again."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning


@contextmanager
def opened(path: Path) -> Iterator[fits.HDUList]:
    """Open a FITS file; astropy's warning of a truncated one is raised."""
    # Opened here, not by astropy, which leaves the file open when its own warning is raised.
    with warnings.catch_warnings(), path.open("rb") as stream:
        warnings.filterwarnings("error", message=".*truncated.*", category=AstropyUserWarning)
        with fits.open(stream) as hdus:
            yield hdus
