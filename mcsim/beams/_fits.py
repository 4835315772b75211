"""Reading FITS so that a truncated file is an error rather than a warning."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from astropy.utils.exceptions import AstropyUserWarning

READ_ERRORS = (OSError, EOFError, ValueError, TypeError, IndexError, KeyError, AstropyUserWarning)
"""What astropy and healpy raise for a file that is not what it should be."""


@contextmanager
def truncation_raises() -> Iterator[None]:
    """Make astropy raise its warning of a truncated file."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*", category=AstropyUserWarning)
        yield
