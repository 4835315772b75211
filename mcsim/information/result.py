"""What a Fisher matrix says of effects: errors, detectable amplitudes, and which can be told apart."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import xarray as xr

from mcsim.datavector.candidate import Candidate, columns_of, numbered
from mcsim.ensemble.datasets import write_dataset
from mcsim.errors import InputError
from mcsim.information.fisher import Information, ordered_pairs, variance_of_mean
from mcsim.information.settings import LimitSettings
from mcsim.stats.detection import snr_needed, snr_to_separate
from mcsim.support.arrays import Matrix, Vector, divided, texts
from mcsim.support.folders import replacing, unwritable
from mcsim.support.numbers import number

TABLE, STORE, PICTURE = "limit.json", "limit.zarr", "limit.png"

COLUMNS = (24, 12, 12, 12, 12, 24, 5, 12)  #: letters after which a cell of the table goes on in the next line

RESOLVED = 1e-10  #: directions of an effect with less than this share of its largest information are unconstrained


@dataclass(frozen=True)
class EffectLimit:
    """The limit of one effect.

    Attributes
    ----------
    name, channel, settings, unit, label, title
        Of the effect; ``channel`` None: acts in all. The label is made of these names, the title of a person's words.
    components
        Number of its linear components.
    sigma, error
        Standard error of its amplitude, for the root mean square response over its components, in ``unit``; and the
        relative error of that from random probes, 0 if there are none. Infinite where the maps do not respond.
    amplitude_90_known
        Amplitude that is detected with the power asked for if this effect is the only one that is tested.
    amplitude_90
        The same if all effects of the library are tested (Bonferroni).
    similar, correlation
        Index of the other effect with the most similar response, None without one, and their canonical correlation.
    separable
        Amplitude at which the right one of the two is chosen with the probability asked for; NaN without another one.
    amplitude_max
        Largest absolute amplitude that the effect can have; infinite if nothing bounds it.
    """

    name: str
    channel: str | None
    settings: dict[str, Any]
    unit: str
    label: str
    title: str
    components: int
    sigma: float
    error: float
    amplitude_90_known: float
    amplitude_90: float
    similar: int | None
    correlation: float
    separable: float
    amplitude_max: float = np.inf

    def amplitude(self, key: str) -> str:
        """Return one of the amplitudes as text, with an asterisk if the effect cannot have it."""
        value = float(getattr(self, key))
        return number(value) + ("*" if self.amplitude_max < value < np.inf else "")


@dataclass(frozen=True, eq=False, repr=False)
class Limits:
    """Hold the limit of every effect, and the Fisher matrix behind it.

    Attributes
    ----------
    model
        Name of the run.
    effects
        In the order of the library.
    correlation
        Largest canonical correlation of the responses of each pair of effects, shape (effects, effects).
    fisher
        Per unit of each component, nuisances marginalised, shape (K, K).
    components
        Label of every row of it.
    tests
        Effects that the look-elsewhere correction counts.
    method
        How the matrix was computed, in words.
    settings
        With which it was computed.
    no_dipole
        Titles of the effects that are known from the monopole and the dipole that they make, where the spectrum says
        that the sky has none.
    """

    model: str
    effects: tuple[EffectLimit, ...]
    correlation: Matrix
    fisher: Matrix
    components: tuple[str, ...]
    tests: int
    method: str
    settings: LimitSettings
    no_dipole: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return the model and the table of :meth:`lines`."""
        return "\n".join([f"<Limits of {self.model}>", *self.lines()])

    @property
    def impossible(self) -> bool:
        """Return True if an effect has an amplitude here that it cannot have."""
        keys = ("amplitude_90_known", "amplitude_90", "separable")
        return any(one.amplitude(key).endswith("*") for one in self.effects for key in keys)

    @property
    def conventions(self) -> str:
        """Say what the amplitudes mean."""
        s = self.settings
        known, one = snr_needed(1, 1, 1, None, s.alpha, s.power), snr_needed(1, self.tests, 1, None, s.alpha, s.power)
        return (
            f"Detected: with {100 * s.power:g} % power at a global level of {100 * s.alpha:g} %, S/N {known:.2f} for "
            f"one component that alone is tested, {one:.2f} with Bonferroni's correction for {self.tests} effects. "
            f"Told apart: the right one of two chosen with {100 * s.separation:g} % probability."
        )

    @property
    def unknowns(self) -> str:
        """Say what is marginalised, and what is known of the dipole of the sky; empty: nothing."""
        known = []
        for name, width in self.settings.nuisances.items():
            kind = (self.settings.library or {}).get(name.partition(":")[0])
            drawn = kind is not None and kind.parametrization.stochastic and kind.parametrization.sign == 0
            known.append(f"{name} ± {width:g}" + (" (its mean shape alone)" if drawn else ""))
        if self.settings.unknown_dipole_uk:
            known.append(f"a monopole and dipole of {self.settings.unknown_dipole_uk:g} µK rms")
        said = [f"Marginalised over {', '.join(known)}."] if known else []
        if self.no_dipole:
            said.append(
                "The spectrum has no monopole and no dipole, so that those of the maps tell most of "
                f"{' and '.join(', '.join(self.no_dipole).rsplit(', ', 1))}; --unknown-dipole-uk 100 leaves that out."
            )
        return " ".join(said)

    def lines(self) -> list[str]:
        """Return the table as text, long cells on more than one line."""
        rows: list[tuple[str, ...]] = []
        rows.append(("effect", "unit", "sigma", "detected alone", "detected", "most similar", "|rho|", "told apart"))
        for one in self.effects:
            similar = ("–", "–", "–")
            if one.similar is not None:
                similar = (self.effects[one.similar].label, f"{one.correlation:.2f}", one.amplitude("separable"))
            detected = (one.amplitude(key) for key in ("amplitude_90_known", "amplitude_90"))
            rows.append((one.label, one.unit, number(one.sigma), *detected, *similar))
        cells = [[wrap(*one, break_long_words=False) for one in zip(row, COLUMNS, strict=True)] for row in rows]
        folded = [line for row in cells for line in zip_longest(*row, fillvalue="")]
        widths = [max(map(len, column)) for column in zip(*folded, strict=True)]
        side = ["<", "<", ">", ">", ">", "<", ">", ">"]
        table = ["  ".join(f"{cell:{side[i]}{widths[i]}}" for i, cell in enumerate(row)) for row in folded]
        worst = max((one.error for one in self.effects), default=0.0)
        error = f" Errors of sigma from random probes: at most {100 * worst:.2g} %." if worst else ""
        marked = "*: more than the effect can have (mcsim effects says what is possible)." if self.impossible else ""
        said = [marked, self.conventions, f"{self.method}.{error}", self.unknowns]
        return [*(line.rstrip() for line in table), *filter(None, said)]

    def to_json(self) -> dict[str, Any]:
        """Return the table in the layout of ``limit.json``."""
        s = self.settings
        return {
            "schema": 1,
            "model": self.model,
            "alpha": s.alpha,
            "power": s.power,
            "separation": s.separation,
            "tests": self.tests,
            "conventions": self.conventions,
            "method": self.method,
            "nuisances": dict(s.nuisances),
            "unknown_dipole_uk": s.unknown_dipole_uk,
            "effects": [self._effect_json(one) for one in self.effects],
        }

    def _effect_json(self, one: EffectLimit) -> dict[str, Any]:
        other = None if one.similar is None else self.effects[one.similar]
        similar = None if other is None else {key: getattr(other, key) for key in ("name", "channel", "settings")}
        named = {key: getattr(one, key) for key in ("name", "channel", "settings", "unit", "components")}
        amplitudes = {key: getattr(one, key) for key in ("sigma", "amplitude_90_known", "amplitude_90", "separable")}
        amplitudes["amplitude_max"] = one.amplitude_max
        finite = {key: value if np.isfinite(value) else None for key, value in amplitudes.items()}
        return named | finite | {"sigma_relative_error": one.error, "similar": similar, "correlation": one.correlation}

    def to_dataset(self) -> xr.Dataset:
        """Return table, correlations and Fisher matrix with names and units."""
        named = {
            "sigma": "standard error of the amplitude, rms over components",
            "amplitude_90_known": "amplitude detected if this effect alone is tested",
            "amplitude_90": "amplitude detected among all effects",
            "separable": "amplitude at which it is told apart from the most similar effect",
        }
        columns: dict[str, Any] = {}
        for key, text in named.items():
            values = np.array([getattr(one, key) for one in self.effects])
            columns[key] = ("effect", values, {"units": "see unit", "long_name": text})
        columns["unit"] = ("effect", texts(one.unit for one in self.effects), {"long_name": "unit of the amplitudes"})
        error = np.array([one.error for one in self.effects])
        columns["sigma_relative_error"] = ("effect", error, {"units": "1", "long_name": "error from random probes"})
        shape = ("effect", "other"), self.correlation
        columns["correlation"] = (*shape, {"units": "1", "long_name": "largest canonical correlation of responses"})
        text = "Fisher information per unit of each component, nuisances marginalised"
        columns["fisher"] = (("component", "component_"), self.fisher, {"units": "1/units^2", "long_name": text})
        labels, names = texts(one.label for one in self.effects), texts(self.components)
        coordinates = {
            "effect": ("effect", labels, {"long_name": "effect"}),
            "other": ("other", labels, {"long_name": "the other effect of a correlation"}),
            "component": ("component", names, {"long_name": "linear component of an effect"}),
            "component_": ("component_", names, {"long_name": "the other component of the matrix"}),
        }
        attributes = {"model": self.model, "conventions": self.conventions, "method": self.method, "tests": self.tests}
        attributes["unknowns"] = self.unknowns
        return xr.Dataset(columns, coordinates, attributes)

    def save(self, folder: str | Path, picture: bytes | None = None) -> None:
        """Write ``limit.zarr``, the picture as ``limit.png``, and last ``limit.json``, in place of earlier ones.

        The folder is made where it does not exist.
        """
        target = Path(folder)
        with unwritable(target, "choose another folder"), replacing(target, TABLE, PICTURE) as scratch:
            write_dataset(self.to_dataset(), scratch / STORE)
            if picture is not None:
                (scratch / PICTURE).write_bytes(picture)
            text = json.dumps(self.to_json(), indent=2, ensure_ascii=False) + "\n"
            (scratch / TABLE).write_text(text, encoding="utf-8")


def check_replaced(folder: Path, model: str) -> None:
    """Raise InputError for a folder with the limit of another model; what cannot be read is no limit."""
    try:
        former = json.loads((folder / TABLE).read_text(encoding="utf-8"))["model"]
    except (OSError, ValueError, TypeError, KeyError):
        return
    if former != model:
        raise InputError(
            f"{folder} holds the limit of {former}, and this is {model}; choose another folder with -o, or delete that "
            "one."
        )


def marginalised(fisher: Matrix, nuisances: Sequence[int], widths: Sequence[float]) -> Matrix:
    """Return the Fisher matrix of the other rows, marginalised over nuisances with Gaussian priors of these widths.

    Notes
    -----
    F_tt - F_tn (F_nn + diag(1/width^2))^-1 F_nt, the inverse of the covariance of the rows that are left.
    """
    return fisher[_others(fisher, nuisances)] @ _unexplained(fisher, nuisances, widths)


def _others(fisher: Matrix, rows: Sequence[int]) -> list[int]:
    return [row for row in range(len(fisher)) if row not in set(rows)]


def _unexplained(fisher: Matrix, nuisances: Sequence[int], widths: Sequence[float]) -> Matrix:
    """Return the combinations of rows that nuisances with priors of these widths leave of the others, shape (K, left).

    Notes
    -----
    W, 1 in the row that is left and -(F_nn + diag(1/width^2))^-1 F_nt in nuisances. A small change of F by dF changes
    the marginalised matrix by W^t dF W.
    """
    rest = _others(fisher, nuisances)
    own = fisher[np.ix_(nuisances, nuisances)] + np.diag(1.0 / np.asarray(widths, dtype=float) ** 2)
    found = np.zeros((len(fisher), len(rest)))
    found[rest] = np.eye(len(rest))
    found[nuisances] = -np.linalg.solve(own, fisher[np.ix_(nuisances, rest)])
    return found


def canonical_correlations(fisher: Matrix, groups: Sequence[Sequence[int]]) -> Matrix:
    """Return the largest canonical correlation of each pair of groups of rows, shape (groups, groups).

    It is the largest singular value of F_ii^-1/2 F_ij F_jj^-1/2; 0 for a group without information.
    """
    roots = []
    for group in groups:
        values, vectors = np.linalg.eigh(fisher[np.ix_(group, group)])
        kept = values > RESOLVED * max(values[-1], 0.0)
        roots.append(vectors[:, kept] / np.sqrt(values[kept]))
    found = np.eye(len(groups))
    for i, one in enumerate(groups):
        for j, other in enumerate(groups[:i]):
            block = roots[i].T @ fisher[np.ix_(one, other)] @ roots[j]
            if block.size:
                found[i, j] = found[j, i] = min(float(np.linalg.norm(block, 2)), 1.0)
    return found


def limits_of(
    candidates: Sequence[Candidate],
    information: Information,
    tests: int,
    method: str,
    model: str,
    settings: LimitSettings,
) -> Limits:
    """Turn the Fisher matrix of candidates, nuisances among them, into limits."""
    width = [_width(candidate, settings) for candidate in candidates]
    known = [k for k, one in enumerate(width) if one is not None]
    rows = columns_of(candidates, known)
    widths = [float(width[k] or 0.0) for k in known for _ in candidates[k].columns]
    fisher = marginalised(information.fisher, rows, widths)
    rest = [candidate for candidate, one in zip(candidates, width, strict=True) if one is None]
    left = numbered(rest)
    correlation = canonical_correlations(fisher, [candidate.columns for candidate in left])
    sizes = _sizes(left, fisher)
    errors = 0.5 * divided(_errors_of_sizes(left, information, _unexplained(information.fisher, rows, widths)), sizes)
    found = []
    for index, candidate in enumerate(left):
        own = list(candidate.columns)
        values = np.linalg.eigvalsh(fisher[np.ix_(own, own)])
        rank = max(int(np.sum(values > RESOLVED * values[-1])), 1)
        sigma = 1.0 / np.sqrt(sizes[index]) if sizes[index] > 0.0 else np.inf
        others = np.where([one.identity == candidate.identity for one in left], -1.0, correlation[index])
        similar = int(np.argmax(others)) if np.any(others > 0.0) else None
        rho = 0.0 if similar is None else float(correlation[index, similar])
        apart = np.nan if similar is None else float(snr_to_separate(rho, settings.separation))
        found.append(
            EffectLimit(
                *candidate.identity,
                {**candidate.settings, **candidate.fixed},
                candidate.effect.unit,
                candidate.label,
                candidate.title,
                len(own),
                sigma,
                float(errors[index]),
                sigma * snr_needed(rank, 1, rank, None, settings.alpha, settings.power),
                sigma * snr_needed(rank, tests, rank, None, settings.alpha, settings.power),
                similar,
                rho,
                sigma * apart,
                candidate.largest,
            )
        )
    names = tuple(f"{one.label}/{k}" for one in left for k in range(len(one.columns)))
    return Limits(model, tuple(found), correlation, fisher, names, tests, method, settings)


def _sizes(candidates: Sequence[Candidate], fisher: Matrix) -> Vector:
    """Return the information of each effect at unit amplitude, the mean over its directions, shape (candidates,)."""
    found = []
    for candidate in candidates:
        typical, own = candidate.typical, fisher[np.ix_(candidate.columns, candidate.columns)]
        found.append(max(float(np.einsum("kj,kl,lj", typical, own, typical)) / typical.shape[1], 0.0))
    return np.array(found)


def _errors_of_sizes(candidates: Sequence[Candidate], information: Information, left: Matrix) -> Vector:
    """Return the errors of :func:`_sizes` from random probes; ``left`` are the rows that nuisances leave, (K, left)."""
    found = np.zeros(len(candidates))
    for place, candidate in enumerate(candidates):
        typical = left[:, candidate.columns] @ candidate.typical
        for group in information.pairs:
            responses = np.tensordot(typical, group, (0, 0))
            found[place] += ordered_pairs(group) ** 2 * variance_of_mean(0.5 * np.mean(responses**2, axis=0))
    return np.sqrt(found) / max(sum(map(ordered_pairs, information.pairs)), 1)


def _width(candidate: Candidate, settings: LimitSettings) -> float | None:
    """Return the width of a nuisance's prior; None: the candidate is no nuisance."""
    name, channel = candidate.identity
    return settings.nuisances.get(f"{name}:{channel}", settings.nuisances.get(name))
