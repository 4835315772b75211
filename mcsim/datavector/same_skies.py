"""Simulate data vectors of the same skies without effects and with them: in typical skies, or in constrained ones."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from typing import Literal

import healpy
import numpy as np

from mcsim import config, systematics
from mcsim.datavector.added_maps import Added, AddedMaps
from mcsim.datavector.analysis import Analysis, Job
from mcsim.datavector.campaign import Ask, after_jobs, constrained_jobs, without_repeats
from mcsim.datavector.filter_model import Model, seen_through, smoothing
from mcsim.datavector.shared_sky import shared_sky
from mcsim.instrument.beams import Beam
from mcsim.simulation import convolve, windows
from mcsim.simulation.channels import table_of
from mcsim.simulation.survey import Channel
from mcsim.sphere import alm as alm_
from mcsim.sphere import rotation
from mcsim.sphere.alm import degrees, orders
from mcsim.support.arrays import Alm, Cl, Map, Matrix, Vector, divided
from mcsim.systematics.added import DipoleResidual

SMALL = 2e-3  #: gain of a channel that observed skies may have in them: responses are wrong by less than this share

BENT = 0.02
"""Change of a beam or a pixel's window at some degree, beside a gain, that observed skies may have in them: up to that
share of a response that is simulated there is missing, with the weight that the channel has in the sky, and a fit is as
much too large."""

ASKEW = 0.1  #: what orders m > 0 add to a beam that observed skies may have in them: it is no sky, but for its square

FAR = 0.1  #: gain up to which maps are divided by it

NOISY = 0.2  #: change of the variance of noise that the filter of observed skies need not know

ROUNDS, STILL = 8, 1e-3  #: of finding a sky that effects change otherwise, and relative change at the end

FEW = 32  #: degrees of a sky that tell if effects make means of it

Factors = tuple[tuple[float, ...], ...]  #: by which channels see degrees otherwise, (channel, lmax + 1); (): not

Orders = tuple[bytes, ...]
"""What beams have more in orders m > 0, by channel: complex b_lm, (m, lmax + 1), the first row zero; b"": little."""

Noise = tuple[float, ...]  #: factors of the variance of the noise of channels; (): about one

Turned = str  #: run (JSON) whose effects turn the sky that all channels see into another; "": they do little

Gains = tuple[float, ...]  #: of each map, beside those of its channel; (): all is close to 1

Seen = tuple[Factors, Noise, Orders, Added, Turned, Gains]
"""How channels see a sky otherwise, what maps show besides, and what was done to the sky itself."""

Skies = Literal["reference", "typical", "constrained"]


@dataclass(frozen=True, eq=False)
class SameSkies:
    """Simulate pairs for observed maps, in the order of the model's, which constrain the skies on request.

    All data vectors have the numbers beside them behind them: shape (skies, p + E).
    """

    analysis: Analysis
    ask: Ask
    maps: Sequence[Map]
    noise: Sequence[config.Effect] = ()  # that all simulations have, but for those with such effects of their own
    _done: dict[tuple[str, int, int, bytes, bool], Matrix] = field(default_factory=dict, init=False)  # by :func:`_key`

    @property
    def observed(self) -> Alm:
        """Return the filtered sky of the maps, uK, shape (size,)."""
        return self.observed_with(())

    def observed_with(self, found: Sequence[config.Effect]) -> Alm:
        """Return the filtered sky of the maps if they have effects: as the channels see it then.

        Notes
        -----
        A gain 1 + g of one channel, or of one map, is in the filtered sky with a weight w: its response there is 1 + w
        g times the true one, and a fit gives g/(1 + w g). So it is with each degree that a beam loses. Gains up to
        SMALL and beams up to BENT stay, most steps of linear responses among them. What orders m > 0 of a beam add to a
        map, beyond ASKEW, is another map of the sky, which is in the filtered one with a weight, too: it is computed
        from the sky that is found, and taken from the maps, until that sky changes no more. Other noise changes the
        weights. What effects show without a sky, a foreground or a residual dipole behind a mask, is simulated and
        taken from the maps first. Where a sky has a part of it already, the effect adds more than it did to the data,
        and the fit too little. A modulation of the sky itself is undone in what was filtered: a fit would be too small
        by the square of its amplitude.
        """
        return self._skies(self.seen(found))

    @cached_property
    def _added(self) -> AddedMaps:
        return AddedMaps(self.analysis)

    def less_added(self, found: Sequence[config.Effect]) -> list[Map]:
        """Return the observed maps, uK, without what effects add to them, whatever their sky."""
        return self._added.less(self.maps, self._added.whole_run(found))

    @cached_property
    def _skies(self) -> Callable[[Seen], Alm]:
        return cache(self._sky)

    def _sky(self, seen: Seen) -> Alm:
        """Return the filtered sky of the maps if channels see it otherwise."""
        factors, noise, orders, added, turned, gains = seen
        maps: Sequence[Map] = _divided(self._added.less(self.maps, added), gains)
        found = before = self._through(factors, noise, maps)
        changed = np.inf
        for _ in range(ROUNDS if orders else 0):
            last, before, found = changed, found, self._through(factors, noise, self._without(orders, found, maps))
            changed = float(np.linalg.norm(found - before) / np.linalg.norm(before))
            if changed >= last:
                return before
            if changed < STILL:
                break
        return self._turned_back(found, turned) if turned else found

    def _turned_back(self, sky: Alm, turned: Turned) -> Alm:
        """Return the sky of the model that effects of a run turn into a filtered one."""
        run, model = config.from_json(turned), self.analysis.model
        first, frame = model.survey.making.channels[0], model.survey.config.map.frame
        site, acting = replace(first.site, lmax=model.lmax), self._acting(first, run.effects)
        here = found = rotation.rotate_alm(sky, model.lmax, model.frame, frame)
        alone = systematics.looked_at(acting, 0.0 * sky, site, 0, 0)  # is taken from the maps
        for _ in range(ROUNDS):
            change = systematics.looked_at(acting, found, site, 0, 0) - found - alone
            # Nothing is filtered from maps at degrees where the sky has no power.
            last, found = found, here - alm_.multiply(change, (model.cl > 0.0).astype(np.float64), model.lmax)
            if np.linalg.norm(found - last) < STILL * np.linalg.norm(found):
                break
        return rotation.rotate_alm(found, model.lmax, frame, model.frame)

    def _through(self, factors: Factors, noise: Noise, maps: Sequence[Map]) -> Alm:
        """Return the filtered sky of maps whose degrees channels see otherwise, with other noise."""
        model, (gains, _) = self._model(factors, noise), self._split(factors)
        return shared_sky(model, _divided(maps, [float(gains[part.channel]) for part in model.parts]))

    @cached_property
    def _model(self) -> Callable[[Factors, Noise], Model]:
        return lru_cache(maxsize=1)(self._model_of)

    def _model_of(self, factors: Factors, noise: Noise) -> Model:
        """Return the model of maps whose degrees channels see otherwise, but for their gains, with other noise."""
        model, (_, shapes) = self.analysis.model, self._split(factors)
        if not noise and np.all(shapes == 1.0):
            return model
        return seen_through(model, model.response * shapes, np.array(noise or np.ones(len(shapes))))

    def _split(self, factors: Factors) -> tuple[Vector, Matrix]:
        """Return gains by which maps are divided, (channel,), and what else changes each degree, (channel, lmax + 1).

        A gain beyond FAR makes noise far from what the filter takes it to be, if maps are divided by it.
        """
        rows = np.array(factors) if factors else np.ones_like(self.analysis.model.response)
        gains = np.where((np.ptp(rows, axis=1) == 0.0) & (np.abs(rows[:, 0] - 1.0) <= FAR), rows[:, 0], 1.0)
        return gains, rows / gains[:, None]

    def spread(self, factors: Factors, noise: Noise = ()) -> Cl | None:
        """Return by how much skies scatter about the observed one, over that without effects, (lmax + 1,); None: 1."""
        if not (factors or noise):
            return None
        return np.sqrt(divided(self._model(factors, noise).unknown, self.analysis.model.unknown, 1.0))

    def _without(self, orders: Orders, sky: Alm, maps: Sequence[Map]) -> list[Map]:
        """Return maps without what other orders of the beams show of a sky."""
        model, made = self.analysis.model, []
        for part, map_ in zip(model.parts, maps, strict=True):
            more = np.frombuffer(orders[part.channel], dtype=np.complex128).reshape(-1, model.lmax + 1)
            if len(more):
                channel = model.survey.channels[part.channel]
                through = convolve.response(Beam(more[: part.moments.smax + 1]), model.lmax, channel.window)
                added = convolve.noncircular_map(convolve.spin_maps(sky, through, model.nside), part.moments)
                map_ = np.where(map_ == healpy.UNSEEN, map_, map_ - added)
            made.append(map_)
        return made

    def seen(self, found: Sequence[config.Effect]) -> Seen:
        """Return how the channels see a sky otherwise with effects."""
        return (
            self.factors(found),
            self.noise_of(found),
            self.orders(found),
            self._added.run_of(found),
            self.turned(found),
            self.gains(found),
        )

    def gains(self, found: Sequence[config.Effect]) -> Gains:
        """Return the gains that effects give to single maps; () if all are close to 1."""
        model, row = self.analysis.model, []
        acting = [self._acting(channel, found) for channel in model.survey.channels] if found else []
        for part in model.parts if found else ():
            site = replace(model.survey.channels[part.channel].site, split=part.split)
            row.append(1.0 + systematics.shared_gain(acting[part.channel], site))
        return tuple(row) if any(abs(one - 1.0) > SMALL for one in row) else ()

    def turned(self, found: Sequence[config.Effect]) -> Turned:
        """Return the run with those effects that turn the sky of all channels into another; "" if they do little."""
        own = [one for one in found if one.channel is None and self.is_pattern(one) and not self._added.is_small(one)]
        return config.to_json(replace(self.analysis.run, effects=tuple(own))) if own else ""

    def noise_of(self, found: Sequence[config.Effect]) -> Noise:
        """Return by how much effects change the variance of the noise of each channel; () if all is little."""
        model = self.analysis.model
        channels = model.survey.channels if found else ()
        row = [model.noise_change(self._acting(one, found), index) for index, one in enumerate(channels)]
        return tuple(row) if any(abs(one - 1.0) > NOISY for one in row) else ()

    def orders(self, found: Sequence[config.Effect]) -> Orders:
        """Return what effects add to the orders m > 0 of the beams; () if all is little."""
        model, rows = self.analysis.model, []
        for made in model.survey.making.channels if found else ():
            before, after = (beam.blm[:, : model.lmax + 1] for beam in self._beams(made, found))
            change = np.zeros((max(len(before), len(after)), model.lmax + 1), dtype=np.complex128)
            change[: len(after)] += after
            change[: len(before)] -= before
            change[0] = 0.0
            little = np.abs(change).max() == 0.0 or made.side_b is not None
            little = little or divided(np.abs(change).max(axis=0), np.abs(before[0])).max() <= ASKEW
            rows.append(b"" if little else (change * smoothing(made, model.lmax)).tobytes())
        return tuple(rows) if any(rows) else ()

    def _acting(self, channel: Channel, found: Sequence[config.Effect]) -> list[systematics.Effect]:
        library = dict(self.analysis.library)
        own = [one for one in found if one.channel in (None, channel.name)]
        return [systematics.build(library[one.name], dict(one.parameters)) for one in own]

    def _beams(self, made: Channel, found: Sequence[config.Effect]) -> tuple[Beam, Beam]:
        """Return the beam of a channel without effects on its shape and with them, before maps are prepared."""
        return made.site.beam, systematics.seen_through(self._acting(made, found), made.site, displacing=())

    def factors(self, found: Sequence[config.Effect]) -> Factors:
        """Return by how much effects change what each channel sees, by degree; () if all is close to 1.

        It is one number for all degrees where the effects rescale the channel as a whole.
        """
        model, rows = self.analysis.model, []
        for made in model.survey.making.channels if found else ():
            acting = self._acting(made, found)
            row = np.full(model.lmax + 1, systematics.rescaling(acting, made.site))
            before, after = (beam.blm[0, : model.lmax + 1].real for beam in self._beams(made, found))
            shape = np.where(before > 0.0, divided(after, before), 1.0)
            there = windows.stretched(made.window, made.site.nside, systematics.spread_of((*made.effects, *acting)))
            shape *= divided(there, made.seen_window)[: model.lmax + 1]
            rows.append(shape if np.abs(shape / row - 1.0).max() > BENT else row)
        return (
            () if all(np.abs(row - 1.0).max() <= SMALL for row in rows) else tuple(tuple(row.tolist()) for row in rows)
        )

    def skies_of(self, effect: config.Effect) -> Skies:
        """Return in which skies the response to an effect is measured.

        One with a mean response, or a drawn pattern, is of typical skies: the observed sky has its power already. So it
        has what a window does to it, if no other channel shows the sky.
        """
        how = dict(self.analysis.library)[effect.name].parametrization
        if how.stochastic:
            return "constrained" if how.mean_response else "typical"
        return "reference" if how.mean_response or self._changes_power(effect) else "constrained"

    def is_pattern(self, effect: config.Effect) -> bool:
        """Return True for an effect on the observed sky that makes a monopole or a dipole of its other degrees."""
        built = systematics.build(dict(self.analysis.library)[effect.name], dict(effect.parameters))
        site = self.analysis.model.survey.channels[0].site
        return self.skies_of(effect) == "constrained" and makes_means(built, site)

    def _changes_power(self, effect: config.Effect) -> bool:
        """Return True for what a beam, or a pixel, does to the power of the sky of the only channel."""
        kind, alone = dict(self.analysis.library)[effect.name], len(self.analysis.model.channels) == 1
        return alone and systematics.acts_through(kind, "beam", "spread")

    def dipole_left_uk(self, found: Sequence[config.Effect]) -> Vector:
        """Return the dipole that beams with effects leave in the only channel, uK, shape (3,); zero with several.

        It is in the frame in which maps are made. What a simulator of another program sees of a dipole is not known.
        """
        channels, known = self.analysis.model.survey.making.channels, DipoleResidual.name in dict(self.analysis.library)
        if len(channels) > 1 or not known or self.analysis.source is not None:
            return np.zeros(3)
        before, after = (beam.blm[0, 1].real for beam in self._beams(channels[0], found))
        return np.asarray((after / before - 1.0) * channels[0].site.dipole_uk)

    def dipole_left(self, found: Sequence[config.Effect]) -> list[config.Effect]:
        """Return the same as the effect of a residual dipole; [] if there is none."""
        if not (left := self.dipole_left_uk(found)).any():
            return []
        effect = DipoleResidual(**DipoleResidual.parametrization.nearest(left, np.eye(3)))
        return [table_of(effect, self.analysis.model.channels[0])]

    def ahead(self, each: Sequence[config.Effect], skies: int, odd: bool = False) -> None:
        """Simulate single effects at once that :meth:`of_reference` or :meth:`pair` will be asked for one by one.

        One by one they would leave workers waiting. ``odd``: it is :meth:`odd` that will be asked. InputError if one of
        them cannot be simulated.
        """
        kinds = [([*without_repeats(self.noise, [effect]), effect], self.skies_of(effect)) for effect in each]
        sets = [(found, kind == "constrained", None if kind == "reference" else skies) for found, kind in kinds]
        jobs = [job for one in sets for job in self._jobs(*one, there=one[0])]
        jobs += [replace(job, negative=True) for job in jobs if odd]
        self._simulate(jobs)

    def of_reference(self, found: Sequence[config.Effect]) -> Matrix:
        """Return data vectors with effects, of the skies with which responses are measured."""
        return self._simulated(self._jobs([*without_repeats(self.noise, found), *found], False, None))

    def pair(
        self,
        found: Sequence[config.Effect],
        skies: int,
        constrained: bool,
        negative: bool = False,
        acting: Sequence[config.Effect] = (),
    ) -> tuple[Matrix, Matrix]:
        """Return data vectors of the same skies without effects and with them, which the observed maps have too.

        ``negative``: of constrained skies with the other sign. ``acting``: effects that the simulator must know, too.
        """
        noise = without_repeats(self.noise, found)
        there = [*noise, *found]
        jobs = [replace(job, negative=negative) for job in self._jobs(there, constrained, skies, there=there)]
        same = self._jobs(noise, constrained, skies, there=there)
        if acting and self.analysis.source_of(acting, given_sky=constrained) is None:
            jobs = [replace(job, source=None) for job in jobs]
        same = [replace(job, source=jobs[0].source, negative=negative) for job in same]
        return self._simulated(same), self._simulated(jobs)

    def odd(self, found: Sequence[config.Effect], skies: int) -> Matrix:
        """Return what changes of data vectors by effects have of the sign of constrained skies, shape (skies, p + E).

        A dipole of our motion keeps its own: its products with the sky are in it, those of the sky with itself are not.
        """
        (before, after), (other, changed) = (self.pair(found, skies, True, negative) for negative in (False, True))
        return 0.5 * ((after - before) - (changed - other))

    def _jobs(
        self,
        found: Sequence[config.Effect],
        constrained: bool,
        skies: int | None,
        there: Sequence[config.Effect] = (),
    ) -> list[Job]:
        """List the jobs that simulate effects."""
        if not constrained or skies is None:
            jobs = after_jobs(self.analysis, found, skies)
        else:
            observed, spread = self.observed_with(there), self.spread(self.factors(there), self.noise_of(there))
            jobs = constrained_jobs(self.analysis, found, observed, range(skies), spread)
        source = self.analysis.source_of(found, given_sky=constrained)
        return [replace(job, slices=True, source=source) for job in jobs]

    def _simulated(self, jobs: Sequence[Job]) -> Matrix:
        self._simulate(jobs)
        return np.concatenate([self._done[_key(job)] for job in jobs])

    def _simulate(self, jobs: Sequence[Job]) -> None:
        """Simulate what has not been simulated for these data."""
        missing = {_key(job): job for job in jobs if _key(job) not in self._done}
        if missing:
            self._done.update(zip(missing, self.ask(list(missing.values())), strict=True))


def _divided(maps: Sequence[Map], gains: Sequence[float]) -> list[Map]:
    """Return maps, each over its gain; no gains: as they are."""
    pairs = zip(maps, gains or [1.0] * len(maps), strict=True)
    return [map_ if g == 1.0 else np.where(map_ == healpy.UNSEEN, map_, map_ / g) for map_, g in pairs]


def makes_means(effect: systematics.Effect, site: systematics.Site) -> bool:
    """Return True if an effect that draws nothing makes a monopole or a dipole of the other degrees of the sky."""
    if effect.parametrization.stochastic or not systematics.acts_through(effect, "sky"):
        return False
    site = replace(site, lmax=min(site.lmax, FEW))
    ell, m = degrees(site.lmax), orders(site.lmax)
    sky = np.asarray(np.where(ell > 1, 1.0 + 1.0j * (m > 0), 0.0), dtype=np.complex128)
    with_sky, alone = (effect.sky(one, site, lambda stage: np.random.default_rng(0)) for one in (sky, 0.0 * sky))
    return bool(np.any((with_sky - alone)[ell <= 1]))


def _key(job: Job) -> tuple[str, int, int, bytes, bool]:
    """Return all that tells jobs for the same data apart; of the skies a hash, since they are large and many."""
    given = hashlib.blake2b(job.given, digest_size=16).digest()
    return job.simulated, job.first, job.count, given, job.source is None
