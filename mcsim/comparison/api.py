"""Compare two simulations of the same skies: which difference, where, how large, and what is left."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.comparison import report
from mcsim.comparison.catalogue import library
from mcsim.comparison.effects import effects_of
from mcsim.comparison.looks import look
from mcsim.comparison.output import REPORT, RESULT, check_output, place
from mcsim.comparison.pairs import ChannelPair, Comparison, Given, given, read
from mcsim.comparison.prediction import PRECISION, Set
from mcsim.comparison.result import UNMADE, ChannelResult, ComparisonResult, DifferenceResult, Verdict
from mcsim.comparison.scene import Scene
from mcsim.comparison.search import INTERPOLATED, INTERPOLATING, Problem
from mcsim.comparison.shown_sky import adds_orders, shown_skies, with_fewer_orders, with_shown_sky
from mcsim.errors import InputError
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_number
from mcsim.support import folders
from mcsim.support.progress import reporting

ROUNDING = 1e-6  #: rms of a difference over that of the sky that single precision makes
INTERPOLATION = 1e-3  #: the same for the interpolation of a sky between pixels or grid points

CLEARLY = 0.1
"""Share of what a named set leaves that one of exchanged sides must leave at most to be named in its place.

Of what single samples change: what a set may leave at most without them if side B has nothing of that.
"""

DOUBTFUL = 0.01
"""Share that a set that is named may leave, beyond which differences of the last stage are tried all the same."""

DOUBTFUL_TOGETHER = 1e-5  #: the same of several differences, beyond which the model may rather describe side B
UNLIKE = 0.2  #: correlation of two sides below which they show different skies
SAME_SKY = 0.9  #: correlation with the sky of side A below which effects are simulated on the sky of side B again


def compare(
    a: str | Path | Given,
    b: str | Path | Given,
    model: str | Path | config.RunConfig | None = None,
    output: str | Path | None = None,
    *,
    accuracy: float = INTERPOLATION,
    quiet: bool = True,
) -> ComparisonResult:
    """Explain why two sets of maps of the same skies differ.

    Parameters
    ----------
    a, b
        Two sides: folders with ``{channel}.fits`` or ``{channel}_{split}.fits``, HEALPix, uK or the unit of their
        headers, without noise or with the same noise, or with a subfolder of these for each realization, of which 00000
        is compared; configurations with the same sky, of which realization 0 is simulated; or arrays, shape (npix,)
        each, by name ("channel" or "channel:split") or in the order of the model's maps.
    model
        Run that describes side A: beams, scans, nside, lmax; by default side A if it is a configuration, or
        ``model.toml`` in its folder; else the same of side B, which then describes that; else ``model.toml`` beside
        side A.
        Without one, only differences of the maps themselves are tried: units, calibration, monopole, dipole, order of
        the pixels, exchanged files.
    output
        Folder for ``compare.json`` and ``report.html``, in place of those of the same case and sides; None: nothing is
        written.
    accuracy
        Rms of a difference over that of the sky up to which maps that differ in no known way are called identical.
    quiet
        Report no progress.

    Returns
    -------
    ComparisonResult
        Verdict, differences with amplitudes, what they explain, and what is left.

    Raises
    ------
    InputError
        If the maps or the model cannot be used, or do not fit each other.

    Notes
    -----
    The sky is taken from side A, its beam and pixel window divided out, unless the model names it. Every difference
    changes the simulation of the model; what changes is added to side A and compared with side B by least squares.
    Where the pointing is known, the best sets are simulated sample by sample. A set is named if it explains 95 % of the
    variance (80 % without single samples); a larger one only if each further member explains most of what is left. Data
    are deterministic: nothing is tested against cosmic variance.

    Examples
    --------
    >>> import mcsim
    >>> run = mcsim.load_config("tiny")
    >>> [here] = mcsim.write_maps(run, "compare-a", realizations=0)
    >>> found = mcsim.compare(here, here, run)
    >>> found.verdict
    'identical'
    """
    check_number(accuracy, "accuracy", "shares of the sky")
    if not 0.0 < accuracy < 1.0:
        raise InputError(f"accuracy = {accuracy:g} is no share of the sky; give a number between 0 and 1.")
    for side in (a, b):
        if not isinstance(side, str | Path | Mapping | Sequence | np.ndarray):
            raise InputError(
                f"a side is a {type(side).__name__}; give the path of a folder of maps or of a configuration, or "
                "arrays by name or in the order of the model's maps."
            )
    nthreads = os.cpu_count() or 1
    a, b = (folders.user_path(side) if isinstance(side, str | Path) else side for side in (a, b))
    if output is not None:
        output = folders.user_path(output)
        folders.writable(output)
    paths: tuple[str, ...] = ()
    if isinstance(a, str | Path) and isinstance(b, str | Path):
        case, paths = Path(b).absolute().name, (place(a), place(b))
        check_output(output, paths, case)
        sides = read(a, b, model, nthreads)
    elif isinstance(a, str | Path) or isinstance(b, str | Path):
        raise InputError("one side is a folder and the other arrays; give two folders or two lists of maps.")
    else:
        if model is None:
            raise InputError(
                "sides that are no paths are maps of which nothing is known; give the model whose maps they are."
            )
        run = model if isinstance(model, config.RunConfig) else config.load(model)
        case = run.name
        check_output(output, paths, case)
        sides = given(a, b, run, nthreads)
    found = []
    with reporting("channels compared", float(len(sides.pairs)), "channels", quiet) as progress:
        for number, pair in enumerate(sides.pairs):
            found.append(_channel(pair, sides, accuracy))
            progress(number + 1.0)
    result = ComparisonResult(case, tuple(found), sides.not_compared, sides.shown, paths)
    if output is not None:
        text = json.dumps(result.to_dict(), indent=1, allow_nan=False) + "\n"
        with folders.filling(target := Path(output)), folders.replacing(target, RESULT) as scratch:
            (scratch / REPORT).write_text(report.page(result), encoding="utf-8")
            (scratch / RESULT).write_text(text, encoding="utf-8")
    return result


def _channel(pair: ChannelPair, sides: Comparison, accuracy: float) -> ChannelResult:
    others = [other for other in sides.pairs if other.name != pair.name]
    same = _rms((pair.b - pair.a)[pair.seen]) <= ROUNDING * _sky_rms(pair)
    pair, cut = (pair, None) if same else with_fewer_orders(pair)
    if cut is None:
        return _either_way(pair, others, sides, accuracy)
    found = _either_way(cut, others, sides, accuracy)
    if found.differences or not adds_orders(cut, pair):
        return found
    whole = _either_way(pair, others, sides, accuracy)
    return whole if whole.differences else found


def _either_way(pair: ChannelPair, others: Sequence[ChannelPair], sides: Comparison, accuracy: float) -> ChannelResult:
    """Return what explains a pair, from side A or from side B."""
    found, problem, unexplained = _explained(pair, others, sides, accuracy)
    accepted = DOUBTFUL if len(found.differences) == 1 else DOUBTFUL_TOGETHER
    named = found.verdict != "unknown"
    if problem is None or pair.scene is None or found.verdict == "identical" or (named and unexplained < accepted):
        return found
    # An effect of side A changes the sky that its maps show through the model's beam, and may have no name there.
    not_made = problem.unmade > UNMADE * found.rms_uk
    turned_pair, turned_others = pair.exchanged(), [other.exchanged() for other in others]
    shown = turned_pair if problem.pair.doubt is None else with_shown_sky(turned_pair)
    if not (not_made or problem.worse_alone_than(problem.of_pair(shown, turned_others))):
        return found
    turned, *_ = _explained(turned_pair, turned_others, sides, accuracy)
    worse = named and turned.left > CLEARLY * found.left
    if turned.verdict in ("unknown", "identical") or worse:
        return found
    return turned


def _explained(
    pair: ChannelPair, others: Sequence[ChannelPair], sides: Comparison, accuracy: float
) -> tuple[ChannelResult, Problem | None, float]:
    """Return what explains a pair whose side A is described by the model, the problem that was solved, if any.

    Last comes the share of the variance that is left beyond what noise may hide.
    """
    sky, _ = (_sky_rms(pair, side) for side in "AB")
    if _rms((pair.b - pair.a)[pair.seen]) <= ROUNDING * sky:
        return _result(pair, "identical"), None, 0.0
    by_moments, *by_samples = shown_skies(pair)
    best = _explained_in(by_moments, others, sides, accuracy, sky)
    for one in by_samples:
        assert one.spread is not None
        change = _rms(one.spread[one.seen])
        if best[0].left_rms_uk > CLEARLY * change:
            found = _explained_in(one, others, sides, accuracy, sky)
            if _has_change(change, *(way[0] for way in (best, found))):
                best = found
    return best


def _has_change(change: float, without: ChannelResult, found: ChannelResult) -> bool:
    """Return True if a pair with a change in side A, uK rms, is explained so much better that side B must have it."""
    if "unknown" in (without.verdict, found.verdict) and without.verdict != found.verdict:
        return without.verdict == "unknown"
    less = without.left_rms_uk**2 - found.left_rms_uk**2
    return less > 0.5 * change**2 or found.left_rms_uk < CLEARLY * without.left_rms_uk


def _explained_in(
    pair: ChannelPair, others: Sequence[ChannelPair], sides: Comparison, accuracy: float, sky: float
) -> tuple[ChannelResult, Problem | None, float]:
    """Return the same of a pair as its side A was made; ``sky``: rms of side A, uK."""
    second = pair.turned != sides.of_b  # the model was taken for that of the other side first
    pair = pair.where_different(ROUNDING * sky)
    rms = _rms((pair.b - pair.a)[pair.seen])
    if rms <= ROUNDING * sky:
        return _result(pair, "identical"), None, 0.0
    problem = Problem(pair, others, accuracy * sky, library(sides.frame))
    sets = problem.best()
    # Next to nothing is left in K, whatever else differs.
    if sides.run is not None and not (sets and problem.complete(sets[0]) and sets[0].size == 1.0):
        problem = replace(problem, library=(*problem.library, *effects_of(pair, sides.run)))
        sets = problem.best(1)
        there = problem.scene(sets[0].members) if sets and not second else None
        if there is not None and not problem.complete(sets[0]) and _correlation(pair, there) < SAME_SKY:
            seen_there = effects_of(replace(pair, scene=there), sides.run)
            problem = replace(problem, library=(*problem.library, *seen_there))
            sets = problem.best(1)
    if second and not (sets and problem.suffices(sets[0])):
        return _result(pair, "unknown"), problem, 1.0
    if not sets or not problem.suffices(sets[0]) or problem.unexplained(sets[0]) > DOUBTFUL:
        sets = sorted([*sets, *problem.best(2)], key=lambda one: one.left)
    swapped = bool(sets) and any(difference.exchanges for difference, _ in problem.preferred(sets)[0].members)
    if rms > accuracy * sky and (not sets or not problem.suffices(sets[0]) or swapped):
        behind = problem.behind()
        if behind and (not sets or problem.adds(behind[0], sets[0])):
            sets = behind
    small = rms <= accuracy * sky and bool(sets) and sets[0].names <= INTERPOLATING
    small = small and ("interpolation" in sets[0].names or sets[0].left > INTERPOLATED)
    if not sets or not problem.suffices(sets[0]) or small:
        verdict: Verdict = "identical" if rms <= accuracy * sky else "unknown"
        return _result(pair, verdict, (), problem, sets), problem, 1.0
    sets = problem.preferred(sets)
    sets[0] = problem.pruned(sets[0])
    known = {equal[0] for difference, value in sets[0].members for equal in difference.equivalent(value)}
    others_too = [one for one in problem.alternatives(sets) if not known.intersection(d.name for d, _ in one.members)]
    chosen = [sets[0], *others_too]
    return _result(pair, _verdict(chosen), chosen, problem, sets), problem, problem.unexplained(sets[0])


def _correlation(pair: ChannelPair, other: Scene) -> float:
    """Return the correlation of the skies of a pair and of another scene."""
    assert pair.scene is not None
    one, there = pair.scene.sky, other.sky
    return float(np.vdot(one, there).real / max(float(np.linalg.norm(one) * np.linalg.norm(there)), 1e-300))


def _verdict(chosen: Sequence[Set]) -> Verdict:
    if len(chosen) > 1:
        return "degenerate"
    return "mixture" if len(chosen[0].members) > 1 else "difference"


def _result(
    pair: ChannelPair,
    verdict: Verdict,
    chosen: Sequence[Set] = (),
    problem: Problem | None = None,
    sets: Sequence[Set] = (),
) -> ChannelResult:
    seen, explained, size = pair.seen, np.zeros_like(pair.a), 1.0
    if chosen and problem is not None:
        explained, size = problem.of(chosen[0]).maps - pair.a, chosen[0].size
    described = [_described(one, problem) for one in chosen if problem is not None]
    same = [other for one, own in zip(chosen, described, strict=False) for other in _equivalent(one, own, pair.turned)]
    nearest = _described(sets[0], problem) if sets and problem is not None else ()
    scene, noise = pair.scene, pair.noise_uk
    return ChannelResult(
        name=pair.name,
        splits=pair.splits,
        verdict=verdict,
        differences=described[0] if described else (),
        alternatives=(*same, *described[1:]),
        nearest=nearest,
        nearest_explains=sets[0].explains if nearest else 0.0,
        rms_uk=_rms((pair.b - pair.a)[seen]),
        sky_rms_uk=_sky_rms(pair),
        noncircular_rms_uk=np.nan if scene is None else _rms(scene.noncircular()[seen]),
        noise_rms_uk=np.nan if noise is None else _rms(noise[seen]),
        left_rms_uk=_rms((pair.b - pair.a - explained)[seen]) / size,
        looks=_looks(pair, explained) if verdict in ("unknown", "identical") else (),
        unmade_rms_uk=problem.unmade if verdict == "unknown" and problem is not None else 0.0,
        a=pair.b if pair.turned else pair.a,
        b=pair.a if pair.turned else pair.b,
        explained=-explained if pair.turned else explained,
        seen=seen,
        one_sided=pair.one_sided,
        differing=pair.differing,
        absent=pair.absent,
        spread_rms_uk=0.0 if pair.spread is None else _rms(pair.spread[seen]),
        hits=pair.hits,
        reversed=pair.turned,
    )


def _looks(pair: ChannelPair, explained: NDArray[np.float64]) -> tuple[str, ...]:
    """Return what is left looks like, in the map that has most of it."""
    left = np.where(pair.seen, pair.b - pair.a - explained, 0.0)
    most = int(np.argmax(np.sum(left**2, axis=1)))
    here = pair.seen[most]
    alike = float(np.corrcoef(pair.a[most, here], pair.b[most, here])[0, 1])
    if abs(alike) < UNLIKE:
        return (f"of another sky, or of pixels in another order: the sides correlate by {alike:.2f}",)
    return look(left[most], pair.a[most], pair.seen[most], None if pair.hits is None else pair.hits[most])


def _described(found: Set, problem: Problem) -> tuple[DifferenceResult, ...]:
    """Return the members of a set in the order in which they act: from side B to side A it is the other one."""
    described = []
    for index, (difference, made) in enumerate(found.members):
        value, said = made, [difference.said(made)]
        if problem.pair.turned:
            value = difference.inverse(made)
            said = [difference.said(value), difference.found(made)]
        rest = (*found.members[:index], *found.members[index + 1 :])
        without = problem.left(rest, found.correction) if rest else 1.0
        described.append(
            DifferenceResult(
                difference.name, problem.pair.name, difference.amplitude(value), difference.unit,
                without - found.left, difference.parameters(value), difference.met, "; ".join(filter(None, said)),
            )
        )  # fmt: skip
    return tuple(described[::-1] if problem.pair.turned else described)


def _equivalent(found: Set, own: tuple[DifferenceResult, ...], exchanged: bool) -> list[tuple[DifferenceResult, ...]]:
    """Return the sets that make the same maps under other names."""
    members = [(d, d.inverse(v)) for d, v in found.members[::-1]] if exchanged else list(found.members)
    same = []
    for i, (d, (difference, value)) in enumerate(zip(own, members, strict=True)):
        # A turn of psi that is mirrored after it is one of the beam the other way.
        mirrored = difference.turns and sum(later.mirrors for later, _ in members[i + 1 :]) % 2
        for name, amplitude, unit in difference.equivalent(-value if mirrored else value):
            other = replace(d, name=name, amplitude=amplitude, unit=unit, parameters={})
            same.append((*own[:i], other, *own[i + 1 :]))
    return same


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _sky_rms(pair: ChannelPair, side: str = "A") -> float:
    """Return the rms of a side over the pixels that are seen, monopole and dipole fitted and taken off."""
    axes = healpix.centres(pair.nside)
    left = []
    for one, seen in zip(pair.a if side == "A" else pair.b, pair.seen, strict=True):
        t = np.vstack([np.ones(int(seen.sum())), axes[:, seen]]).T
        left.append(one[seen] - t @ np.linalg.lstsq(t, one[seen], rcond=None)[0])
    size = _rms(np.concatenate(left))
    if size <= PRECISION:
        label = "AB"["AB".index(side) ^ pair.turned]
        raise InputError(f"the maps of {pair.name} on side {label} are constant; give maps of a sky.")
    return size
