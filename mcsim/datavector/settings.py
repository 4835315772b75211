"""All levels, cuts, bins and numbers of simulations of a diagnosis, in one object."""

from dataclasses import dataclass, fields, replace
from typing import Any

from mcsim.errors import InputError
from mcsim.stats.few_draws import LEAST
from mcsim.stats.look_elsewhere import FEWEST
from mcsim.support.settings import check_settings
from mcsim.systematics import Library

_FIRST = {
    "sims_per_element": 2,
    "pilot_sims_per_element": 2,
    "worth_per_element": 7.0,
    "response_error": 0.15,
    "channel_skies": 2,
    "typical_skies": 3,
    "common_skies": 6,
    "noisy_skies": 12,
    "time_ordered_skies": 1,
    "scan_sims": 100,
}
"""Numbers of simulations of a first verdict."""

_OF_A_SAMPLE: dict[str, Any] = {"sims_per_element": 10, "pilot_sims_per_element": 3}
"""Numbers of simulations of a sample covariance."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """Set the effects, levels, cuts, bins and numbers of simulations of a diagnosis.

    Attributes
    ----------
    without
        Names of effects that are no candidates.
    library
        Effects by name, as :func:`mcsim.effects` returns them; None: those of them that are proposed without a request.
    including
        Names of effects that are candidates although they are proposed on request alone; those of a ``library`` that is
        given always are.
    only
        Names of the effects that alone are candidates, those on request too; empty: all but ``without``. A result has
        the others in ``without``, and this empty.
    simulations
        Simulations for the covariance of the data vector, which then is that of the sample; None: ``sims_per_element``
        for each of its elements.
    controls
        Data sets that are drawn from the model at higher fidelity and diagnosed too: what they say tells if the verdict
        on the data can be trusted (:mod:`mcsim.diagnosis.controls`).
    alpha
        Global p-value up to which the model does not describe the data.
    residual_level, further_level
        A set of effects is accepted if the p-value of its residual is above the first, and the global p-value of the
        most significant further effect above the second. High levels lose true sets; low ones miss unknown effects.
    max_effects
        Largest number of effects that act together.
    named_probability
        Posterior probability below which the accepted sets of a faint gap are not named.
    faint_pvalue
        Global p-value above which sets have to be so probable by the templates that were known before the data, too.
    odds_cut
        Explanations that are less probable than the best by this factor are left out.
    template_error
        Relative error of templates in white norm.
    prior_snr
        Standard deviations of the amplitudes' prior, in units of their errors: flat in the logarithm.
    partial_level, partial_effects, partial_refusals
        If no set is accepted: global p-value up to which a further effect is detected, largest number of effects, and
        refused effects before the search ends.
    exchanged_pvalue
        P-value of chi^2 above which maps in another order are said to fit the model.
    reduction_sigma
        Standard deviations by which a fractional reduction on held-out data may miss its prediction, or zero.
    unexplained_pvalue
        P-value up to which what remains of held-out data contradicts effects that leave more than half of their excess.
    half_snr_share, half_snr
        Share of an effect's expected S/N that each half needs for a reduction to be measured, and the S/N that suffices
        whatever its share.
    consistency_level
        Global p-value of the comparisons of an effect's amplitude in independent parts of the data, and of what it
        leaves in them, up to which it is not named.
    absence_odds
        Odds of no effect against it, in the data without the part that supports it most, over the number of comparisons
        that tell such odds, from which on it is not named.
    consistency_error
        Relative error of an effect's response in these parts that is tolerated.
    compared_sets
        Sets of effects that are simulated for it, the most probable ones.
    slice_snr
        Expected S/N of an effect in a part of the data from which on the part counts; half of it for one on noise.
    place_pvalue
        P-value up to which a group of numbers is listed before others of a kind listed already.
    sims_per_element, pilot_sims_per_element
        Simulations per independent element of the data vector, at least ``scan_sims`` in all; and per element, after
        which these are counted.
    worth_per_element
        Simulations of a sample covariance per independent element that a shrunk one must be worth, after which no more
        are made: looked at from 500 on, with 250 elements or more.
    shrunk
        Shrink the covariance (:func:`mcsim.stats.shrinkage.shrunk`), unless ``simulations`` is given. That of a sample
        needs 10 per element.
    redundant
        Directions of the data vector with less than this fraction of the largest variance are dropped.
    response_modes
        (lmax + 1)^2 times skies over which a response is averaged: its noise is below 3e-3 of its Fisher matrix.
    response_error
        Relative error of the size of a response in one channel (its upper limit by the scatter among skies) above which
        it is averaged over twice as many, and again, ``noisy_skies`` at most.
    channel_skies, typical_skies, common_skies, noisy_skies
        Least number of skies over which a response is averaged: in one channel; of a sky with another mean response;
        of a sky whose response in one realization is mostly random; if the change itself is random or has one sign.
        Maps that show more than 65,536 modes of the sky need fewer of all but the last, and of ``time_ordered_skies``.
    opposite_share
        Share of these skies in which the opposite step is simulated too; the others take its curvature from these.
    table_skies
        Skies over which the response of measured spectra is averaged, ``noisy_skies`` at most.
    constrained_skies, scatter_skies
        Skies, constrained by the data, on which fitted effects are simulated; the same for the scatter of stochastic
        effects.
    time_ordered_skies
        Skies seen sample by sample, with which the default route is compared.
    scan_sims
        Simulations of the bipolar scan.
    refine_rounds, joint_rounds
        Largest number of rounds of simulating responses at fitted amplitudes, for single effects and for sets.
    nonlinear_sigma
        Departure of a response from linear, in standard deviations, that is tolerated.
    noisy_share, clean_sigma
        Of templates with more than this share of noise in their squared norm elements above so many standard errors are
        kept, and of the others the share that is not noise.
    sky_scatter
        Relative scatter of a response above which it is simulated for the observed sky.
    stochastic_level
        Global p-value up to which a stochastic effect is simulated at its amplitude, if no single effect is accepted;
        all are if no set of effects is.
    settled_sigma, settled_share
        Amplitudes have converged if they move by less than so many standard errors, or by this share.
    tried
        Single candidates that are simulated at their amplitude if no single effect is accepted; up to twice as many if
        they explain nearly as much as the best.
    beam_orders, split_beam_orders
        Highest azimuthal order m of a beam that is measured; the same for every map of a channel by itself.
    noise_floor
        Least noise per pixel over the rms of the sky.
    hole_iterations
        Most iterations of filling unobserved pixels with the filtered sky; 0: they are zero.
    hidden_share
        Share of the sky that a map lacks, as behind a mask, from which on maps are filtered by their inverse
        covariance, and not isotropically. 0: always, which costs a quarter more for each simulation. Maps that show the
        sky beyond the filters have that of their mean in any case.
    uneven_noise
        Mean variance of the noise of a map's pixels times the mean of its inverse, 1 for even noise, above which maps
        are filtered so on the full sky too, unless the sky is far above the noise at the last degree.
    filter_tolerance, filter_iterations
        At which the conjugate gradients of that filter end for typical maps: what is left of the system, relative to
        what the filter leaves of the sky, and most iterations. Simulations and data go through the same ones, so that
        tests hold for any: they cost power alone. The sky that responses are measured in has a hundredth of the
        tolerance, and ten times the iterations.
    sky_bins, beam_bins
        Bins in l of the spectrum of the sky, for each parity of l, which end where the bands of the effect ``spectrum``
        do; of each azimuthal order of a beam, from m = 0.
    latitude_edges
        Edges of bands of the sky, in abs(sin(latitude)).
    plane_width
        Width in sin(b) of the profile of the Galactic plane.
    large_scales
        Highest degree of signals fixed to the sky that are compared between channels.
    scan_L_max, scan_bins
        Highest L of the bipolar scan, which ends at ``biposh.L_max`` too; its bins in l.
    missing_share
        Largest share of the pixels hit by the fiducial scan that observed maps may lack.
    rms_ratio, cl_ratio, biposh_ratio
        Largest ratio to the model, either way, of the rms of a map and of C_l, and of BipoSH to their standard
        deviation: beyond it the unit is wrong.
    agreement_level
        p-value up to which mcsim's own simulation does not agree with that of an external model.
    small_chi2_pvalue
        Probability of a smaller chi^2 below which a table of spectra is refused.
    correlated_sigma
        Errors of a chance correlation from which on two elements are correlated.

    Notes
    -----
    Each setting but ``controls`` has a part in the key of the cache: another value simulates the model anew.

    Examples
    --------
    Leave an effect out, and know only two:

    >>> import mcsim
    >>> mcsim.DiagnosisSettings(without=("beam_ellipticity",)).without
    ('beam_ellipticity',)
    >>> library = {name: kind for name, kind in mcsim.effects().items() if name in ("gain_drift", "beam_width")}
    >>> sorted(mcsim.DiagnosisSettings(library=library, simulations=500).library)
    ['beam_width', 'gain_drift']

    Ask for a first verdict from fewer simulations:

    >>> mcsim.DiagnosisSettings.quick(without=("beam_ellipticity",)).sims_per_element
    2
    """

    without: tuple[str, ...] = ()
    library: Library | None = None
    including: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    simulations: int | None = None
    controls: int = 0
    alpha: float = 0.05
    residual_level: float = 0.01
    further_level: float = 0.005
    max_effects: int = 6
    named_probability: float = 0.5
    faint_pvalue: float = 0.01
    odds_cut: float = 100.0
    template_error: float = 0.01
    prior_snr: tuple[float, ...] = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0)
    partial_level: float = 0.005
    partial_effects: int = 6
    partial_refusals: int = 6
    exchanged_pvalue: float = 0.01
    reduction_sigma: float = 3.0
    unexplained_pvalue: float = 1e-3
    half_snr_share: float = 0.2
    half_snr: float = 5.0
    consistency_level: float = 0.01
    absence_odds: float = 20.0
    consistency_error: float = 0.05
    compared_sets: int = 4
    slice_snr: float = 2.0
    place_pvalue: float = 0.01

    sims_per_element: int = 3
    pilot_sims_per_element: int = 2
    worth_per_element: float = 10.0
    shrunk: bool = True
    redundant: float = 1e-4
    response_modes: int = 1 << 14
    response_error: float = 0.07
    channel_skies: int = 3
    typical_skies: int = 6
    common_skies: int = 12
    noisy_skies: int = 24
    opposite_share: float = 1.0 / 3.0
    table_skies: int = 24
    constrained_skies: int = 8
    scatter_skies: int = 48
    time_ordered_skies: int = 3
    scan_sims: int = 300

    refine_rounds: int = 8
    joint_rounds: int = 4
    nonlinear_sigma: float = 0.5
    noisy_share: float = 0.01
    clean_sigma: float = 5.0
    sky_scatter: float = 0.1
    stochastic_level: float = 0.05
    settled_sigma: float = 0.3
    settled_share: float = 0.05
    tried: int = 3

    beam_orders: int = 4
    split_beam_orders: int = 2
    noise_floor: float = 1e-3
    hole_iterations: int = 30
    hidden_share: float = 0.01
    uneven_noise: float = 3.0
    filter_tolerance: float = 1.0
    filter_iterations: int = 30
    sky_bins: int = 8
    beam_bins: tuple[int, ...] = (4, 2, 2, 1, 1)
    latitude_edges: tuple[float, ...] = (0.0, 0.25, 0.6, 1.0)
    plane_width: float = 0.2
    large_scales: int = 64
    scan_L_max: int = 4
    scan_bins: int = 3

    missing_share: float = 0.01
    rms_ratio: float = 20.0
    cl_ratio: float = 25.0
    biposh_ratio: float = 1000.0
    agreement_level: float = 0.01
    small_chi2_pvalue: float = 1e-6
    correlated_sigma: float = 5.0

    def __post_init__(self) -> None:
        """Raise InputError for settings of another kind, negative numbers, levels above 1, and counts too small."""
        levels = [field.name for field in fields(self) if field.name.endswith(("_level", "_pvalue", "_share"))]
        skies = ("channel_skies", "typical_skies", "common_skies", "noisy_skies", "table_skies")
        sims = ("sims_per_element", "pilot_sims_per_element", "worth_per_element")
        least: dict[str, float] = dict.fromkeys((*skies, *sims, "constrained_skies"), 2)
        one = ("max_effects", "odds_cut", "beam_orders", "beam_bins", "sky_bins", "scan_bins", "scan_L_max")
        least |= dict.fromkeys((*one, "filter_iterations", "compared_sets"), 1)
        least |= {"scatter_skies": LEAST, "scan_sims": FEWEST, "large_scales": 3, "plane_width": 1e-3}
        check_settings(self, ["alpha", "named_probability", *levels], least)
        edges = list(self.latitude_edges)
        if len(edges) < 2 or edges != sorted(set(edges)):
            raise InputError(f"latitude_edges = {self.latitude_edges!r} are no ranges; give two or more, rising.")
        orders = max(self.beam_orders, self.split_beam_orders)
        if len(self.beam_bins) <= orders:
            raise InputError(
                f"beam_bins = {self.beam_bins} has bins for {len(self.beam_bins)} orders of a beam, but orders 0 to "
                f"{orders} are measured; give {orders + 1} numbers, or a lower beam_orders."
            )

    @classmethod
    def quick(cls, **changes: Any) -> "DiagnosisSettings":
        """Return the settings of a first verdict, with changes by name.

        There are fewer simulations of everything, and responses are averaged over fewer skies.
        The same model diagnosed with the default settings goes on with these simulations. With nuisances, and for
        measured spectra, the covariance is that of as many simulations as otherwise.
        """
        return cls(**(_FIRST | changes))

    @property
    def strong_skies(self) -> int:
        """Return how many skies tell the scatter of an effect on the data that outweighs that of the model."""
        return max(self.constrained_skies, self.noisy_skies)

    def shrinks(self, simulations: int | None) -> bool:
        """Return True if the covariance from so many simulations, None for the default number, is shrunk."""
        return self.shrunk and simulations is None

    def without_shrinkage(self) -> "DiagnosisSettings":
        """Return the settings with as many simulations as a sample covariance needs."""
        few = self.sims_per_element in (_FIRST["sims_per_element"], DiagnosisSettings().sims_per_element)
        return replace(self, shrunk=False, **(_OF_A_SAMPLE if few else {}))

    def of_a_simulation(self) -> "DiagnosisSettings":
        """Return the settings with the default numbers of simulations, on which no single simulation depends."""
        whole = DiagnosisSettings()
        names = ("simulations", "shrunk", "opposite_share", *_FIRST)
        return replace(self, **{name: getattr(whole, name) for name in names})
