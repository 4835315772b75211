"""The result of a diagnosis: one typed object that the report, the figures and the command line read."""

import json
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from mcsim.datavector.localisation import Place
from mcsim.datavector.nuisances import NuisanceResult
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element
from mcsim.diagnosis.consistency import Comparison
from mcsim.diagnosis.control_result import Controls
from mcsim.diagnosis.fitted import CandidateResult, EffectResult, EffectSet
from mcsim.diagnosis.selection import Contrast, Verdict
from mcsim.ensemble.datasets import write_dataset
from mcsim.errors import InputError
from mcsim.reconstruction.result import HEAD, Reconstructed
from mcsim.stats.excess import HeldOut, Measured, excess_of
from mcsim.stats.look_elsewhere import GlobalTest
from mcsim.support.arrays import Vector, texts
from mcsim.support.folders import replacing, unreadable, user_path

VERDICT, REPORT, STORE = "verdict.json", "report.html", "diagnosis.zarr"
PLACES = 12  #: groups in the localisation table of ``verdict.json`` and of the report


@dataclass(frozen=True)
class Agreement:
    """Say which simulator an external model is, and if mcsim's own simulation of its description agrees with it."""

    simulator: str  #: in words
    #: pvalue, agrees, skies: of the test with so many of mcsim's skies
    pvalue: float
    agrees: bool
    skies: int
    #: what the external simulations look like, seen from mcsim's: the effect, with its amplitude, nearest to the
    #: difference
    nearest: str | None
    #: names of the effects whose responses the external simulator makes; those of all others are mcsim's
    effects: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class DiagnosisResult:
    """All that a diagnosis says: the verdict, and what it rests on.

    Attributes
    ----------
    case, kind
        Name of the case; "none", "effect", "mixture", "degenerate" or "unknown".
    test
        Test of the whole data vector; with few simulations its chi^2 is too large on average, and ``excess`` is not.
    sets, contrasts
        Sets of effects that describe the data, the most probable first, and what would tell them apart.
    nearest, cosine, nearest_pvalue
        Index of the candidate that lowers chi^2 most, the cosine between its best fit and the departure, and the
        p-value of what this fit leaves; None in results of version 0.1.
    partial, partial_left
        Effects that are detected where no set describes the data, and the fraction of the excess chi^2 that they leave.
    held_out
        Reduction of the excess on held-out data; None where it was not measured.
    places
        Groups of elements, the one that departs most first.
    candidates, elements, maps
        Candidate effects, elements of the data vector, names of the maps.
    data, mean, standard_deviation
        Data vector, and mean and scatter of the simulations, shape (p,).
    templates
        Response per unit coordinate, shape (p, K).
    correlation
        Canonical correlation of the responses of each pair of candidates, shape (C, C).
    held_out_pvalues, calibration
        p-value of each simulation against the others; smaller of the two p-values of draws of the model.
    residual_maps
        Residual of each map in coarse pixels, less the mean and over the scatter of the simulations, RING, NaN where
        nothing was observed, shape (map, npix); None without maps.
    residual_range
        Smallest and largest rms of such maps in 95 % of the simulations, shape (map, 2).
    frame, notes, warnings
        Of the maps; remarks; what makes the verdict unreliable for maps of a real sky.
    settings, provenance
        Settings of the diagnosis; numbers of simulations, the seed and the data, by name.
    configuration
        The run that is the model, as JSON.
    controls
        Diagnoses of data drawn from the model at higher fidelity; None: none were asked for.
    agreement
        Of an external model; None where mcsim simulates.
    nuisances
        What the data say of each component of the declared nuisances, against its prior.
    faint, probability
        True if sets describe the data, but are less probable than all else together; their posterior probability.
    contradicted
        Sets that describe the data vector and are not named, because parts of the data do not bear them out.
    unlisted, unlisted_held_out
        After an unknown gap, what is missing, the most evident structure first; and the reduction of the excess on
        held-out data by all of it. None: not looked for, not measured.
    orders
        Orders of maps or pixels in which the model fits, or noise in common with which it does, a sentence on each: all
        that is said of an unknown gap then.
    untested
        Elements that are not tested, in words: they follow the square of a nuisance as wide as its prior.
    """

    case: str
    kind: Verdict
    test: GlobalTest
    sets: tuple[EffectSet, ...]
    contrasts: tuple[Contrast, ...]
    nearest: int
    cosine: float
    partial: tuple[EffectResult, ...]
    partial_left: float | None
    held_out: HeldOut | None
    places: tuple[Place, ...]
    candidates: tuple[CandidateResult, ...]
    elements: tuple[Element, ...]
    maps: tuple[str, ...]
    data: Vector
    mean: Vector
    standard_deviation: Vector
    templates: Vector
    correlation: Vector
    held_out_pvalues: Vector
    calibration: Vector
    residual_maps: Vector | None
    residual_range: Vector | None
    frame: str
    notes: tuple[str, ...]
    settings: DiagnosisSettings
    provenance: dict[str, Any]
    configuration: str
    warnings: tuple[str, ...] = ()
    nuisances: tuple[NuisanceResult, ...] = ()
    controls: Controls | None = None
    faint: bool = False
    probability: float = 1.0
    agreement: Agreement | None = None
    contradicted: tuple[EffectSet, ...] = ()
    unlisted: tuple[Reconstructed, ...] | None = None
    unlisted_held_out: HeldOut | None = None
    untested: tuple[str, ...] = ()
    nearest_pvalue: float | None = None
    orders: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return case, verdict, p-value and sets of effects."""
        sets = "; or ".join(one.label for one in self.sets)
        return f"<DiagnosisResult {self.case}: {self.kind}, p = {self.test.pvalue:.2g}{sets and f', {sets}'}>"

    @property
    def verdict(self) -> dict[str, Any]:
        """Return ``verdict.json`` as a dictionary."""
        return self.to_json()

    @property
    def effects(self) -> tuple[EffectResult, ...]:
        """Return the effects of the most probable set."""
        return self.sets[0].effects if self.sets else ()

    @property
    def simulations(self) -> int:
        """Return the number of simulations that mean and covariance come from."""
        return len(self.held_out_pvalues)

    @property
    def excess(self) -> Measured:
        """Return the unbiased excess of chi^2 over its degrees of freedom, zero on average where the model is right."""
        return excess_of(self.test.chi2, self.test.dimension, self.provenance.get("worth", self.simulations) - 1)

    @property
    def z(self) -> Vector:
        """Return data less mean over scatter, shape (p,)."""
        return np.asarray((self.data - self.mean) / self.standard_deviation)

    def prediction(self, index: int) -> Vector:
        """Return the change of every element by a set of effects, ``sets[index]``, over the scatter, shape (p,)."""
        one = self.sets[index]
        columns = [column for member in one.candidates for column in self.candidates[member].columns]
        return np.asarray(self.templates[:, columns] @ np.array(one.coordinates) / self.standard_deviation)

    @property
    def z_after(self) -> Vector | None:
        """Return what the best set leaves of :attr:`z`; None without one."""
        return self.z - self.prediction(0) if self.sets else None

    @cached_property
    def ranked(self) -> tuple[CandidateResult, ...]:
        """Return the candidates, the largest fall of chi^2 first."""
        return tuple(sorted(self.candidates, key=lambda one: -one.delta_chi2))

    def to_json(self) -> dict[str, Any]:
        """Return ``verdict.json`` of schema 1."""
        near = self.candidates[self.nearest]
        sets = [[_effect_json(effect) for effect in one.effects] for one in self.sets]
        found = {
            "schema": 1,
            "case": self.case,
            "gap": {"p_value": self.test.pvalue, "statistic": self.test.chi2, "dof": self.test.dimension},
            "verdict": self.kind,
            "faint": self.faint or None,
            "probability": self.probability if self.faint else None,
            "effects": sets[0] if sets else [],
            "alternatives": sets[1:],
            "maps": [asdict(own) for one in self.sets[:1] for own in one.maps],
            "contradicted": [_set_json(one) for one in self.contradicted] or None,
            "odds": [one.odds for one in self.sets],
            "where": [_place_json(place) for place in self.places[:PLACES]],
            "shrink": None if self.held_out is None else self.held_out.to_json(),
            "nearest": {"name": near.name, "channel": near.channel, "cosine": self.cosine},
            "heard": [_effect_json(effect) for effect in self.partial],
            "left": self.partial_left,
            "detectable": [
                {key: getattr(one, key) for key in ("name", "channel", "unit")}
                | {"settings": {**one.settings, **one.fixed}, "amplitude_90": one.detectable}
                | {"amplitude_max": one.largest if np.isfinite(one.largest) else None}
                for one in self.candidates
                if one.detectable is not None
            ],
            "notes": [*self.orders, *self.notes],
            "unlisted": None if self.unlisted is None else [one.to_json() for one in self.unlisted],
            "unlisted_shrink": None if self.unlisted_held_out is None else self.unlisted_held_out.to_json(),
            "untested": list(self.untested) or None,
            "nuisances": [_plain(one) for one in self.nuisances] or None,
            "warnings": list(self.warnings) or None,
            "worth": self.provenance.get("worth"),
            "controls": None if self.controls is None else self.controls.to_json(),
            "simulator": None if self.agreement is None else asdict(self.agreement),
        }
        return {key: value for key, value in found.items() if value is not None or key in ("shrink", "left")}

    def to_dataset(self) -> xr.Dataset:
        """Return the numbers as a dataset over the elements, candidates and maps.

        Attribute ``result`` holds, as JSON, all that is no array.
        """
        rest = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        values: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        values |= {name: np.array([getattr(one, name) for one in self.candidates], float) for name in _OF_CANDIDATES}
        values |= {"z": self.z, "place_z": [p.z for p in self.places], "place_p": [p.p for p in self.places]}
        described = {**_DERIVED, **_ARRAYS, **_OF_CANDIDATES}
        variables = {
            name: (dims, values[name], {"units": units, "long_name": words})
            for name, (dims, units, words) in described.items()
            if values[name] is not None
        }
        labels: dict[str, tuple[str, list[str], str]] = {
            "element": ("element", [one.name for one in self.elements], "element of the data vector"),
            "description": ("element", [one.words for one in self.elements], "what an element measures"),
            "element_unit": ("element", [one.unit for one in self.elements], "unit of an element"),
            "candidate": ("candidate", effects := [one.label for one in self.candidates], "candidate effect"),
            "other": ("other", effects, "the other candidate effect"),
            "column": ("column", [x for one in self.candidates for x in one.components], "component of a candidate"),
            "unit": ("candidate", [one.unit for one in self.candidates], "unit of the amplitude of a candidate"),
            "place": ("place", [one.element.words for one in self.places], "element of a group that departs most"),
        }
        if self.residual_maps is not None:
            labels["map"] = ("map", list(self.maps), "map")
        coordinates = {name: (dim, texts(each), {"long_name": words}) for name, (dim, each, words) in labels.items()}
        return xr.Dataset(variables, coordinates, {"result": json.dumps(rest, default=asdict)})

    def save(self, folder: str | Path, page: str | None = None) -> None:
        """Write ``verdict.json``, ``diagnosis.zarr`` and ``report.html``, the page, into a folder.

        It is made where it does not exist. Reconstructed effects are written there too, a Python file each. What an
        earlier diagnosis has written there is deleted, effects that this one does not use and a report included.
        ``verdict.json`` comes last: a process that is killed leaves a folder without it, with files of one diagnosis.
        """
        target = user_path(folder)
        written = {f"{one.name}.py": one.file for one in self.unlisted or () if one.file is not None}
        written |= {} if page is None else {REPORT: page}
        written[VERDICT] = json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n"
        used = {one.name for one in self.candidates}
        run = json.loads(self.configuration)
        acting = [one["name"] for one in run.get("effect") or ()] + [one["effect"] for one in run.get("nuisance") or ()]
        used |= {Path(name).stem for name in acting}
        earlier = [
            path.name
            for path in target.glob("unlisted_*.py")
            if path.stem not in used and HEAD in path.read_text(encoding="utf-8", errors="replace")
        ]
        with replacing(target, VERDICT, REPORT, *earlier) as scratch:
            for name, text in written.items():
                (scratch / name).write_text(text, encoding="utf-8")
            write_dataset(self.to_dataset(), scratch / STORE)

    @classmethod
    def open(cls, folder: str | Path) -> "DiagnosisResult":
        """Read what :meth:`save` wrote.

        Raises
        ------
        InputError
            If the folder holds no diagnosis, or one that is not whole.
        """
        path = user_path(folder) / STORE
        if not path.is_dir():
            raise InputError(f"{path} does not exist; give the output folder of mcsim diagnose.")
        values: dict[str, Any] = dict.fromkeys(_ARRAYS)
        with unreadable(path, "a diagnosis", "run mcsim diagnose again"):
            with xr.open_zarr(path, chunks=None, consolidated=False) as stored:
                values |= {name: np.asarray(stored[name]) for name in _ARRAYS if name in stored}
                rest = json.loads(stored.attrs["result"])
            hints = get_type_hints(cls)
            values |= {key: TypeAdapter(hints[key]).validate_python(value) for key, value in rest.items()}
            return cls(**values)


_OF_ELEMENT = "see element_unit"
_ARRAYS: dict[str, tuple[str | tuple[str, ...], str, str]] = {
    "data": ("element", _OF_ELEMENT, "data vector"),
    "mean": ("element", _OF_ELEMENT, "mean of the model, as that of its samples where these are known"),
    "standard_deviation": ("element", _OF_ELEMENT, "scatter of the simulations"),
    "templates": (("element", "column"), f"{_OF_ELEMENT}; per unit coordinate", "response per unit coordinate"),
    "correlation": (("candidate", "other"), "1", "canonical correlation of responses"),
    "held_out_pvalues": ("simulation", "1", "p-value of each simulation against the others"),
    "calibration": ("draw", "1", "smaller of the two p-values of draws of the model"),
    "residual_maps": (("map", "pixel"), "1", "residual over the scatter of simulations, RING"),
    "residual_range": (("map", "end"), "1", "smallest and largest rms of 95 % of the simulations"),
}
_OF_CANDIDATES: dict[str, tuple[str | tuple[str, ...], str, str]] = {
    "amplitude": ("candidate", "see unit", "fitted alone"),
    "sigma": ("candidate", "see unit", "standard error"),
    "delta_chi2": ("candidate", "1", "fall of chi^2"),
    "pvalue": ("candidate", "1", "p-value of the fall of chi^2 over all candidates (Bonferroni)"),
    "detectable": ("candidate", "see unit", "amplitude found with 90 % power at 5 % false alarms; NaN: no response"),
}
_DERIVED: dict[str, tuple[str | tuple[str, ...], str, str]] = {
    "z": ("element", "1", "data less mean, over scatter"),
    "place_z": ("place", "1", "normal deviate of a group"),
    "place_p": ("place", "1", "p-value, look-elsewhere included"),
}
"""Dimensions, units and meaning of the variables of a dataset."""


_FOR_PEOPLE = ("label", "words", "consistency", "parts")


def _plain(found: EffectResult | NuisanceResult) -> dict[str, Any]:
    """Return all that is not for people to read."""
    return {name: value for name, value in vars(found).items() if name not in _FOR_PEOPLE}


def _effect_json(effect: EffectResult) -> dict[str, Any]:
    return _plain(effect) | {"consistency": [_comparison_json(effect, one) for one in effect.consistency]}


def _comparison_json(effect: EffectResult, one: Comparison) -> dict[str, Any]:
    """Return the amplitudes of parts of the data in the unit of the effect."""
    amplitudes = [effect.amplitude * value for value in one.amplitudes]
    errors = [abs(effect.amplitude) * value for value in one.errors]
    return {"by": one.kind, "slices": list(one.slices), "amplitude": amplitudes, "sigma": errors, "p": one.pvalue}


def _set_json(one: EffectSet) -> dict[str, Any]:
    return {"effects": [_effect_json(effect) for effect in one.effects], "maps": [asdict(own) for own in one.maps]}


def _place_json(place: Place) -> dict[str, Any]:
    e = place.element
    found = {key: getattr(e, key) for key in ("statistic", "channels", "split", "L", "M", "parity", "ell", "frame")}
    found["statistic"] = {"score": "map", "noise": "cl"}.get(e.statistic, e.statistic)
    lists = {key: list(value) for key, value in found.items() if isinstance(value, tuple)}
    return found | lists | {"measured": e.family, "z": place.z, "p": place.p}
