"""Errors of amplitudes where patterns are drawn: Monte Carlo, k sigma."""

import numpy as np

from mcsim.stats.gaussian import SimulatedGaussian, Tolerated
from mcsim.stats.scattered import variance_beside, with_drawn_scatter

P, SIMULATIONS, DRAWS, TRIALS = 40, 400, 16, 80


def test_pulls_beside_drawn_patterns_have_unit_width() -> None:
    """The pattern moves the amplitudes, and 12 draws tell its 8 modes: the errors of the fit are half of that."""
    rng, count = np.random.default_rng(20140317), 12
    t, truth = rng.normal(size=(P, 2)), np.array([10.0, 4.0])
    modes = rng.normal(size=(P, 8)) * np.array([30.0, 20.0, 20.0, 10.0, 10.0, 10.0, 5.0, 5.0])
    modes[:, 0] = t @ [20.0, 10.0]
    pulls, plain = [], []
    for _ in range(TRIALS):
        null = SimulatedGaussian.from_simulations(rng.normal(size=(SIMULATIONS, P)))
        draws = modes @ rng.normal(size=(8, count))
        scatter = (draws - draws.mean(axis=1, keepdims=True)) * np.sqrt((1.0 + 1.0 / count) / (count - 1.0))
        x = t @ truth + modes @ rng.normal(size=8) + rng.normal(size=P)
        found = null.with_extra_covariance(scatter).fit(x, t)
        wide = with_drawn_scatter(null, t, found, [scatter])
        np.testing.assert_array_equal(wide.amplitudes, found.amplitudes)
        pulls.append((found.amplitudes - truth) / wide.errors)
        plain.append((found.amplitudes - truth) / found.errors)
    # A width has an error of 1/sqrt(2 TRIALS), and that of 12 draws of about a fifth averages out: 3.5 sigma.
    widths, narrow = (np.sqrt(np.mean(np.square(one), axis=0)) for one in (pulls, plain))
    np.testing.assert_allclose(widths, 1.0, atol=3.5 / np.sqrt(2.0 * TRIALS))
    assert np.all(narrow > 1.6)


def test_pulls_have_unit_width_where_noise_is_in_what_is_drawn() -> None:
    """A strong response multiplies noise, so that what it adds is correlated with the data without it."""
    rng, draws, p, trials = np.random.default_rng(20140318), 12, 12, 160
    t, truth = rng.normal(size=(p, 2)), np.array([10.0, 4.0])
    gains = t @ np.linalg.pinv(t)  # along the templates noise is twice what it is without the response
    pulls = []
    for _ in range(trials):
        null = SimulatedGaussian.from_simulations(rng.normal(size=(SIMULATIONS, p)))
        noise, own = rng.normal(size=(p, draws)), rng.normal(size=p)
        without = (noise - noise.mean(axis=1, keepdims=True)) * np.sqrt((1.0 + 1.0 / draws) / (draws - 1.0))
        scatter, x = gains @ without, t @ truth + own + gains @ own
        found = null.with_extra_covariance(scatter).fit(x, t)
        errors = with_drawn_scatter(null, t, found, [scatter], [without]).errors
        pulls.append((found.amplitudes - truth) / errors)
    # Without that correlation it would be sqrt(2), which is most for equal noise and response.
    widths = np.sqrt(np.mean(np.square(pulls), axis=0))
    np.testing.assert_allclose(widths, 1.0, atol=3.5 / np.sqrt(2.0 * trials))


def test_what_is_found_beside_a_drawn_pattern_is_as_rare_as_it_says() -> None:
    """A power law of modes, of which 24 draws hardly tell the weaker ones, along which other templates lie."""
    rng, draws, trials, beside, level = np.random.default_rng(20140317), 24, 200, 12, 0.01
    noise, spectrum = SimulatedGaussian(np.zeros(P), np.eye(P), 100_000), 1000.0 / (1.0 + np.arange(P)) ** 2
    t, columns = np.column_stack([rng.normal(size=P), np.eye(P)[:, 8 : 8 + beside]]), [(k,) for k in range(1 + beside)]
    falls, variances = [], []
    for _ in range(trials):
        pattern = np.sqrt(spectrum)[:, None] * rng.normal(size=(P, draws))
        pattern -= pattern.mean(axis=1, keepdims=True)
        scatter = pattern * np.sqrt((1.0 + 1.0 / draws) / (draws - 1.0))
        wide = noise.with_extra_covariance(scatter)
        x = 30.0 * t[:, 0] + np.sqrt(spectrum * (1.0 + 1.0 / draws)) * rng.normal(size=P) + rng.normal(size=P)
        alone = wide.fit(x, t[:, :1])
        falls.append([alone.chi2 - wide.fit(x, t[:, [0, k]]).chi2 for k in range(1, 1 + beside)])
        variances.append(variance_beside(noise, t, columns, [0], [scatter]))
    variance = np.array(variances)
    np.testing.assert_array_equal(variance[:, 0], 1.0)
    ignored, charged = (
        np.mean(noise.nested_test(np.array(falls), P, 1, 1, Tolerated(0.0, one)) < level)
        for one in (1.0, variance[:, 1:])
    )
    # The templates of one data vector are independent.
    assert abs(charged - level) < 4.0 * np.sqrt(level / np.size(falls))
    assert ignored > 2.0 * level


def test_a_pattern_without_scatter_leaves_the_variance_beside_it() -> None:
    noise = SimulatedGaussian(np.zeros(P), np.eye(P), 1000)
    found = variance_beside(noise, np.eye(P)[:, :3], [(0,), (1,), (2,)], [0], [np.zeros((P, DRAWS))])
    np.testing.assert_array_equal(found, 1.0)


def test_what_two_drawn_patterns_add_to_the_variance_beside_them_adds_up() -> None:
    """Each is held out beside the noise and the other one."""
    rng, noise = np.random.default_rng(3), SimulatedGaussian(np.zeros(P), np.eye(P), 100_000)
    spectrum = 1000.0 / (1.0 + np.arange(P)) ** 2
    patterns = [np.sqrt(spectrum)[:, None] * rng.normal(size=(P, DRAWS)) for _ in range(2)]
    first, second = ((one - one.mean(axis=1, keepdims=True)) / np.sqrt(DRAWS - 1.0) for one in patterns)
    t, columns = np.eye(P)[:, 8:13], [(k,) for k in range(5)]
    alone = [
        variance_beside(noise.with_extra_covariance(other), t, columns, [0, 1], [own]) - 1.0
        for own, other in ((first, second), (second, first))
    ]
    told = np.all(np.array(alone) > 0.0, axis=0)  # by both: none makes less of it
    assert told.sum() >= 2
    both = variance_beside(noise, t, columns, [0, 1], [first, second]) - 1.0
    np.testing.assert_allclose(both[told], sum(alone)[told], rtol=1e-9)
