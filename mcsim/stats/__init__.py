"""Statistics: small-sample Gaussian tests, look-elsewhere corrections, detection power, sums of streams."""
