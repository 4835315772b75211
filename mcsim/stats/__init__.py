"""Statistics: small-sample Gaussian tests, look-elsewhere, detection power, excess chi^2, intervals, streaming sums."""
