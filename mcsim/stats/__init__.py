"""Statistics: small-sample Gaussian tests, look-elsewhere corrections, detection power, intervals, sums of streams."""
