"""A result in sentences, the same in the report, in pictures and on the command line."""

from collections.abc import Sequence
from pathlib import Path

from mcsim.datavector.localisation import Place
from mcsim.datavector.nuisances import NuisanceResult
from mcsim.diagnosis.fitted import EffectResult, EffectSet
from mcsim.diagnosis.result import Agreement, DiagnosisResult
from mcsim.diagnosis.selection import Contrast
from mcsim.reconstruction.structure import ALIKE, OPPOSITE
from mcsim.stats.excess import HeldOut, Measured
from mcsim.support.numbers import measured, number, p_equals

AGREES, DISAGREES = 0.05, 0.005
"""p-value above which data or a residual agree with the simulations, and below which they do not; marginal between."""

SEPARATION = 3.29
"""Distance in standard deviations at which the nearer of two predictions is the right one in 95 cases of 100."""

LARGEST_ERROR = 0.3  #: error of a fractional reduction above which it is not quoted
PIXEL_MEANS = "The maps' headers say that mcsim's default route made them (POINTING), and the model is that, too."
SETS = 2  #: alternatives that a sentence has room for


def sentence(result: DiagnosisResult) -> str:
    """Return the verdict in one sentence."""
    p = p_equals(result.test.pvalue)
    chance = ", which may be chance" if result.test.pvalue > DISAGREES else ""
    if result.kind == "none":
        return f"The model describes the data ({p}){', but for one group of numbers' if _unnoticed(result) else ''}."
    start = f"The model does not describe the data ({p})"
    if result.faint:
        return f"{start}{chance}, but the departure is too faint to name its cause."
    if result.orders:
        return f"{start}. {' '.join(result.orders)}"
    if result.kind == "unknown":
        missing = "".join(f" What is missing {one.says}." for one in (result.unlisted or ())[:1])
        if result.contradicted:
            sets = "; and ".join(_effects(one.effects) for one in result.contradicted[: SETS + 1])
            return f"{start}. Parts of the data do not bear out what fits the data vector: {sets}.{missing}"
        if len(result.partial) > 1 and result.partial_left is not None:
            left = f"{100 * result.partial_left:.0f} % of the excess χ²"
            missing += f" Detected are {_effects(result.partial)}; they leave {left}."
        return f"{start}{chance}, and no effect of the library explains why.{missing}"
    if result.kind == "degenerate":
        shown = [_effects(one.effects) for one in result.sets[: SETS + 1]]
        more = len(result.sets) - len(shown)
        shown += [f"{more} more set{'s' * (more > 1)}"] * (more > 0)
        return f"{start}. It does with {'; or with '.join(shown)}."
    return f"{start}. It does with {_effects(result.effects)}."


def _effects(effects: Sequence[EffectResult]) -> str:
    return " and ".join(f"{effect.label} ({effect.words})" for effect in effects)


def tested(result: DiagnosisResult) -> str:
    """Return what was tested: elements, maps, simulations and candidates."""
    splits = len({one.split for one in result.elements if one.split})
    source = f"{len(result.maps)} map{'s' * (len(result.maps) > 1)}" + (f" ({splits} splits)" if splits > 1 else "")
    if result.residual_maps is None:
        source = "a table of spectra"
    by = "" if result.agreement is None else f" by {result.agreement.simulator}"
    if "worth" in result.provenance:
        by += f", whose shrunk covariance is worth {result.provenance['worth']} of a sample covariance"
    candidates = f"{len(result.candidates)} candidate effects, alone and up to {result.settings.max_effects} together"
    if len(result.candidates) == 1:
        candidates = "one candidate effect"
    return (
        f"{len(result.elements)} elements of the data vector, {result.test.dimension} of them independent, measured "
        f"from {source}; {result.simulations} simulations of the model{by}; {candidates}"
    )


def status(result: DiagnosisResult) -> str:
    """Return what the verdict means, in agreement with the p-values of what is left."""
    if result.kind == "none":
        rest = "An effect below its detectable amplitude can still be there."
        if place := _unnoticed(result):
            rest = f"But one group of numbers does by itself: {place.element.words} (z = {place.z:.1f}, "
            rest += f"{p_equals(place.p)}, look-elsewhere effect included)."
        return f"Neither χ² nor any candidate departs from the simulations. {rest}"
    if result.orders:
        return " ".join(result.orders)
    near, p = result.candidates[result.nearest], result.test.pvalue
    chance = f" Data of the model depart as far in {100 * p:.2g} % of cases." if p > DISAGREES else ""
    if result.faint:
        return (
            f"Nearest is {near.label}. But all sets of effects that describe the data have together a probability of "
            f"{100 * result.probability:.0f} %, against no effect, an unlisted one, and the rest of the library."
            f"{chance}"
        )
    if result.kind == "unknown":
        left = "" if result.nearest_pvalue is None else f"; what it leaves {residual(result.nearest_pvalue)}"
        return (
            f"The most similar candidate is {near.label}: cosine {result.cosine:.2f} with the departure, so that it "
            f"accounts for {100 * result.cosine**2:.0f} % of the excess χ²{left}. It is a hint and not the cause."
            f"{chance}"
        )
    best = result.sets[0]
    if result.kind == "degenerate":
        return (
            f"{len(result.sets)} sets of effects describe the data and the data cannot choose between them. The "
            f"residual of the most probable one {left_by(best)}."
        )
    many = len(best.effects) > 1
    start = f"These {len(best.effects)} effects are needed together" if many else "One effect is enough"
    beside = "no further candidate is significant"
    if min(best.pvalue, best.further) <= AGREES:
        start += ", with a reservation"
    if best.further <= AGREES:
        beside = "the most significant further candidate is marginal"
    return (
        f"{start}: the residual of the fit {left_by(best)}, and {beside} beside {'them' if many else 'it'} "
        f"({p_equals(best.further)}, look-elsewhere effect included)."
    )


def _unnoticed(result: DiagnosisResult) -> Place | None:
    """Return the group of numbers that departs most, if it does and the global test finds nothing."""
    first = next(iter(result.places), None) if result.kind == "none" else None
    return first if first and first.p <= result.settings.place_pvalue else None


def agreement(found: Agreement) -> str:
    """Return if mcsim's own simulation agrees with an external model, and where the responses come from."""
    how = "agrees" if found.agrees else "does not agree"
    text = f"mcsim's own simulation of the description {how} with {found.simulator} "
    text += f"({p_equals(found.pvalue)}, {found.skies} skies)"
    if not found.agrees and found.nearest is not None:
        text += f"; nearest to what is in {found.simulator} beside it is {found.nearest}"
    whose = f"those of {', '.join(found.effects)} are {found.simulator}'s" if found.effects else ""
    how = "" if found.agrees else " and approximate"
    return f"{text}. Responses to effects are mcsim's{how}{f', but {whose}' if whose else ''}."


def chi2(result: DiagnosisResult) -> str:
    """Return the unbiased chi^2 of the data vector, its degrees of freedom and the global p-value.

    This is of chi^2 or of the most significant candidate, whichever is less likely, look-elsewhere effect included.
    """
    dof = result.test.dimension
    value = number(result.excess.value + dof, 4)
    return f"χ² = {value} for {dof} degrees of freedom; global {p_equals(result.test.pvalue)} (χ² and all candidates)"


def residual(pvalue: float) -> str:
    """Return how a residual with this p-value compares with the simulations."""
    how = "agrees" if pvalue > AGREES else "is only marginally compatible" if pvalue > DISAGREES else "does not agree"
    return f"{how} with the simulations ({p_equals(pvalue)})"


def left_by(one: EffectSet) -> str:
    """Return how the residual of a set compares with the simulations, and if only with what is tolerated."""
    text = residual(one.pvalue)
    if one.pvalue_alone is None or one.pvalue <= DISAGREES or one.pvalue_alone > DISAGREES:
        return text
    tolerated = "an error of the response and the scatter of the effects tolerated"
    return f"{text.removesuffix(')')} with {tolerated}, {p_equals(one.pvalue_alone)} without)"


def held_out(result: DiagnosisResult) -> str:
    """Return what adding the effects to the simulator does to data that the fit did not use."""
    found = result.held_out
    if found is None:
        if not result.sets:
            return "Not measured: no effect was added to the simulator."
        return (
            "Not measured: a half of the data hardly measures the effects, or asks for what they cannot be, or the "
            "held-out one shows no excess χ² by itself."
        )
    forecast = f"; {percent(found.predicted)} was predicted"
    if found.predicted.sigma >= LARGEST_ERROR:
        forecast = "; what was predicted is too uncertain to quote"
    return _removed(found, "Adding the best fit to the simulator removes", forecast)


def _removed(found: HeldOut, start: str, forecast: str = "") -> str:
    """Return the reduction on held-out data behind what is done to the simulator, or that it is too uncertain."""
    if found.before.value <= 0.0 or found.achieved.sigma >= LARGEST_ERROR:
        before, after = (measured(one.value, one.sigma) for one in (found.before, found.after))
        return f"Too uncertain to measure a reduction: excess χ² of {found.data} {before} before, {after} after."
    left = f"what remains there {residual(found.pvalue_after)}"
    return f"{start} {percent(found.achieved)} of the excess χ² of {found.data}{forecast}; {left}."


def refuted(found: HeldOut) -> str:
    """Return what effects that held-out data refute do to these."""
    does = f"raises the excess χ² of the other half from {number(found.before.value)} to {number(found.after.value)}"
    if found.after.value < found.before.value:
        removed, forecast = 100.0 * found.achieved.value, 100.0 * found.predicted.value
        does = f"removes {removed:.0f} % of the excess χ² of the other half, where {forecast:.0f} % were predicted"
    if found.pvalue_after <= DISAGREES:
        does += f"; what remains differs from the simulations, {p_equals(found.pvalue_after)}"
    return f"simulated with its amplitude from one half, it {does}"


def unlisted(result: DiagnosisResult) -> list[str]:
    """Return what is missing after an unknown gap, in the words of the grammar; empty if it was not looked for."""
    if result.unlisted is None:
        return []
    if not result.unlisted:
        return ["No structure that the grammar can say describes it: what is missing stays unknown."]
    found = [one.sentence for one in result.unlisted]
    held = result.unlisted_held_out
    if result.unlisted[0].file is None:  # the others are what it leaves
        first, own = result.unlisted[0], ""
        if first.stage == "noise" and first.split not in (ALIKE, OPPOSITE):
            own = f" In the model, split_noise gives {first.split} noise of its own."
        return [*found, f"No effect of the simulator can be like it, so that its reduction is not measured.{own}"]
    if held is None:
        return [*found, "Its reduction on held-out data is not measured: they do not respond to it by themselves."]
    return [*found, _removed(held, "Added to the simulator, this removes")]


def compared_parts(result: DiagnosisResult) -> list[str]:
    """Return the amplitudes of each named effect in parts of the data, and what it removes from the maps."""
    found = [
        f"{effect.label}: {text} ({p_equals(one.pvalue)})"
        for effect in result.effects
        for one, text in zip(effect.consistency, effect.parts, strict=True)
    ]
    for one in result.sets[0].maps if result.sets else ():
        fall, forecast = number(one.before - one.after), number(one.forecast)
        maps = " and ".join(one.maps)
        found.append(
            f"Largest scales of {maps}: χ² falls by {fall}, {forecast} forecast; {p_equals(one.pvalue)} of the rest"
        )
    return found


def percent(fraction: Measured) -> str:
    """Return a fraction with its error in per cent."""
    return measured(100.0 * fraction.value, 100.0 * fraction.sigma, " %")


def apart(result: DiagnosisResult, one: Contrast) -> str:
    """Return how far the predictions of two sets are apart, and what would tell them apart."""
    start = f"The predictions differ by {one.separation:.1f} standard deviations. "
    factor = (SEPARATION / one.separation) ** 2 if one.separation > 0.0 else float("inf")
    if factor <= 1.0:
        odds = result.sets[one.second].odds / result.sets[one.first].odds
        return f"{start}That is enough in most cases; here the second has odds {number(odds)} against the first."
    if one.separation < 0.03:
        return f"{start}More data of this kind cannot tell them apart; another scan, frequency or beam can."
    most = f" of {result.elements[one.elements[0]].words}" if one.elements else ""
    return f"{start}To choose rightly in 95 cases of 100 takes {SEPARATION}: {number(factor)} times as much data{most}."


def summary(result: DiagnosisResult, folder: Path) -> list[str]:
    """Return a summary for the command line, about ten lines."""
    rows = [("warning", warning) for warning in result.warnings]
    rows += [("case", result.case), ("tested", tested(result)), ("global test", chi2(result))]
    rows += [("controls", f"{result.controls.counted}; drawn with {result.controls.drawn}")] if result.controls else []
    rows.append(("verdict", f"{result.kind}. {status(result)}"))
    shown = result.sets[: SETS + 1]
    rows += [("or" if one is not shown[0] else "effect", _numbered(one.effects)) for one in shown]
    if more := len(result.sets) - len(shown):
        rows.append(("or", f"{more} more set{'s' * (more > 1)} in verdict.json"))
    rows += [("detected", _numbered(result.partial))] if result.partial else []
    if result.sets:
        if tests := [one.pvalue for effect in result.effects for one in effect.consistency]:
            counted = "one comparison" if len(tests) == 1 else f"the least likely of {len(tests)} comparisons"
            rows.append(("parts agree", f"{counted} of amplitudes has {p_equals(min(tests))}"))
        rows.append(("held-out data", held_out(result)))
    if result.kind != "none":
        first = result.places[0]
        rows.append(("where", f"{first.element.words}; z = {first.z:.1f}, {p_equals(first.p)}"))
    rows += [("nuisance", f"{one.label}: {one.words}{pulled(one)}") for one in result.nuisances]
    rows += [("note", note) for note in result.notes]
    rows += [("note", f"{untested(result)} The report lists them.")] if result.untested else []
    rows += [("missing", line) for line in unlisted(result)]
    rows += [("looks like", f"{one.cause}.") for one in result.unlisted or () if one.cause]
    files = [f"{one.name}.py" for one in result.unlisted or () if one.file is not None]
    rows.append(("written", f"{folder}: {', '.join(['verdict.json', 'report.html', 'diagnosis.zarr', *files])}"))
    return [f"{name:<14}{text}" for name, text in rows]


def untested(result: DiagnosisResult) -> str:
    """Return a sentence on the number of elements that are not tested."""
    return (
        f"{len(result.untested)} of {len(result.elements)} elements are not tested, because they follow the square of "
        "a nuisance as wide as its prior."
    )


def pulled(one: NuisanceResult) -> str:
    """Return the pull of a nuisance, or that the data do not constrain it."""
    return "; not constrained by the data" if one.pull is None else f"; pull {one.pull:z.1f}".replace("-", "−")


def _numbered(effects: Sequence[EffectResult]) -> str:
    ratios = (f"; amplitude/error {number(one.amplitude / one.sigma, 2)}" if one.sigma > 0.0 else "" for one in effects)
    return "; ".join(f"{one.label}: {one.words}{ratio}" for one, ratio in zip(effects, ratios, strict=True))
