"""All levels, cuts, bins and numbers of simulations of a diagnosis, in one object."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DiagnosisSettings:
    """Set levels, cuts, bins and numbers of simulations; each has a part in the key of the cache."""

    without: tuple[str, ...] = ()  # effects of the library that are no candidates
    simulations: int | None = None  # for the covariance of the data vector; None: sims_per_element for each
    alpha: float = 0.05  # global p-value up to which the model does not describe the data
    # A set of effects is accepted if the p-value of its residual is above the first level, and the global p-value of
    # the most significant further effect above the second. High levels lose true sets; low ones miss unknown effects.
    residual_level: float = 0.02
    further_level: float = 0.005
    max_effects: int = 3  # that may act together
    named_probability: float = 0.5  # posterior, below which the accepted sets of a faint gap are not named
    odds_cut: float = 100.0  # explanations that are less probable than the best by this factor are left out
    template_error: float = 0.01  # relative error of templates in white norm
    # Standard deviations of the amplitudes' prior, in units of their errors: flat in the logarithm.
    prior_snr: tuple[float, ...] = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0)
    # If no set is accepted:
    partial_level: float = 0.005  # global p-value up to which a further effect is detected
    partial_effects: int = 6  # largest number of effects
    partial_refusals: int = 6  # refused effects before the search ends
    exchanged_pvalue: float = 0.01  # of chi^2, above which maps in another order are said to fit the model
    # Standard deviations by which a fractional reduction on held-out data may miss its prediction, or zero.
    reduction_sigma: float = 3.0
    half_snr_share: float = 0.2  # of an effect's expected S/N that each half needs for a reduction to be measured
    place_pvalue: float = 0.01  # up to which a group of numbers is listed before others of a kind listed already

    sims_per_element: int = 10  # simulations per independent element of the data vector
    pilot_sims_per_element: int = 3  # and per element, after which the independent ones are counted
    redundant: float = 1e-4  # directions of the data vector with less than this fraction of the largest variance
    # (lmax + 1)^2 times skies over which a response is averaged: its noise is below 3e-3 of its Fisher matrix.
    response_modes: int = 1 << 14
    # Least number of skies over which a response is averaged: in one channel; of a sky with another mean response; of
    # a sky whose response in one realization is mostly random; if the change itself is random or has one sign.
    channel_skies: int = 3
    typical_skies: int = 6
    common_skies: int = 12
    noisy_skies: int = 24
    table_skies: int = 24  # skies over which the response of measured spectra is averaged
    constrained_skies: int = 8  # skies, constrained by the data, on which fitted effects are simulated
    scatter_skies: int = 24  # the same for the scatter of stochastic effects
    time_ordered_skies: int = 6  # skies seen sample by sample, with which the default route is compared
    scan_sims: int = 300  # simulations of the bipolar scan

    # Largest number of rounds of simulating responses at fitted amplitudes, for single effects and for sets.
    refine_rounds: int = 4
    joint_rounds: int = 4
    nonlinear_sigma: float = 0.5  # departure of a response from linear, in standard deviations, that is tolerated
    # Templates with more than this share of noise in their squared norm keep elements above so many standard errors.
    noisy_share: float = 0.01
    clean_sigma: float = 5.0
    sky_scatter: float = 0.1  # relative, of a response, above which it is simulated for the observed sky
    # Global p-value up to which a stochastic effect is simulated at its amplitude, if no single effect is accepted.
    stochastic_level: float = 0.05
    # Amplitudes have converged if they move by less than so many standard errors, or by this share.
    settled_sigma: float = 0.3
    settled_share: float = 0.05
    tried: int = 3  # single candidates that are simulated at their amplitude if no single effect is accepted

    beam_orders: int = 4  # highest azimuthal order m of a beam that is measured
    split_beam_orders: int = 2  # the same for every map of a channel by itself
    noise_floor: float = 1e-3  # least noise per pixel over the rms of the sky
    hole_iterations: int = 12  # of filling unobserved pixels with the filtered sky
    sky_bins: int = 8  # in l of the spectrum of the sky, for each parity of l
    beam_bins: tuple[int, ...] = (4, 2, 2, 1, 1)  # in l of each azimuthal order of a beam, from m = 0
    latitude_edges: tuple[float, ...] = (0.0, 0.25, 0.6, 1.0)  # of bands of the sky, in |sin latitude|
    plane_width: float = 0.2  # in sin b, of the profile of the Galactic plane
    large_scales: int = 64  # highest degree of signals fixed to the sky that are compared between channels
    scan_L_max: int = 4  # highest L of the bipolar scan
    scan_bins: int = 3  # of the bipolar scan in l

    missing_share: float = 0.01  # largest share of the pixels hit by the fiducial scan that observed maps may lack
    # Largest ratio to the model, either way, of the rms of a map and of C_l, and of BipoSH to their standard deviation:
    # beyond it the unit is wrong.
    rms_ratio: float = 20.0
    cl_ratio: float = 25.0
    biposh_ratio: float = 1000.0
    small_chi2_pvalue: float = 1e-6  # probability of a smaller chi^2 below which a table of spectra is refused
    correlated_sigma: float = 5.0  # in errors of a chance correlation, from which on two elements are correlated
