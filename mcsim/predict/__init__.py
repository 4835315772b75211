"""BipoSH without Monte Carlo: from a beam's b_lm, the moments of a scan and C_l to the mean of an ensemble.

Nothing here is shared with the convolution and the estimator of the ensembles, so that each checks the other.
"""
