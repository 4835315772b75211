"""Texts about a store and about a prediction."""

from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import xarray as xr

from mcsim.ensemble import opening, store
from mcsim.ensemble.tables import spectra, strongest
from mcsim.support.folders import user_path

NEGLIGIBLE = 1e-6
"""Fraction of its error, or of the largest signal to noise, below which a predicted value counts as zero."""

ROUNDING = 1e-12  #: fraction of a coefficient below which its real or imaginary part is an error of rounding

ROWS = 40  #: number of bins of a prediction that are shown


def describe(path: str | Path) -> str:
    """Return a text about a store: configuration, progress, size, and the most significant spectra."""
    target = user_path(path)
    attributes = store.attributes(target)
    done = store.done(target)
    # What a run is writing at the moment may be gone at the next.
    files = [file for file in target.rglob("*") if file.suffix != ".partial" and file.is_file()]
    with opening.open_ensemble(target) as ensemble:
        sizes = dict(ensemble.sizes)
        pairs = [str(pair) for pair in ensemble["pair"].values]
        paired = "biposh_circular" in ensemble
    run, controls = attributes["configuration"], ", with circular-beam controls" if paired else ""
    grid = "rings without pixels" if run["map"].get("grid") == "gl" else f"nside {run['map']['nside']}"
    found = [
        f"{target}: {run['name']}, {int(done.sum())} of {done.size} realizations finished",
        f"  maps      {grid}, {run['map']['frame']} frame, lmax {sizes['ell'] - 1}",
        f"  seed      {run['ensemble']['seed']}",
        f"  pairs     {'; '.join(pairs)}",
        f"  modes     {sizes['mode']}, L <= {run['biposh']['L_max']}{controls}",
        f"  size      {sum(file.stat().st_size for file in files) / 1e6:.1f} MB in {len(files)} files",
        f"  digest    {attributes['digest']}",
        f"  made with {', '.join(f'{name} {number}' for name, number in attributes['packages'].items())}",
    ]
    if others := attributes.get("other_packages"):
        found.append(f"  and with  {', '.join(f'{name} {number}' for name, own in others.items() for number in own)}")
    if (target / "summary").is_dir():
        kind = "_difference" if paired else ""
        names = [f"biposh{kind}_binned_{what}" for what in ("mean", "standard_error")]
        with opening.open_summary(target) as summary:
            known = opening.read_in(summary[[*names, "count"]], target)
            looked_at = int((spectra(known, kind)["sigma"] > 0.0).sum())
            rows = list(strongest(known, kind).head(5).itertuples())
        what = "mean of the difference to the control" if paired else "mean"
        if rows:
            chance = f"the largest of {looked_at} by chance: about {_of_chance(looked_at):.1f} sigma"
            found.append(f"  strongest binned spectra ({what}; {chance}):")
        for row in rows:
            bounds, value = f"l = {row.bin_first}-{row.bin_last}", _value(row.value, row)
            found.append(f"    {row.pair}  {row.mode:8s} {bounds:14s} {value} uK^2, {row.sigma:.1f} sigma")
    return "\n".join(found)


def _of_chance(number: int) -> float:
    """Return the median of the largest of as many absolute normal deviates."""
    return -NormalDist().inv_cdf(-0.5 * float(np.expm1(np.log(0.5) / number)))


def describe_prediction(prediction: xr.Dataset) -> str:
    """Return a text on a prediction: its order, its strongest binned spectra, and its signal to noise if present."""
    attrs = prediction.attrs
    text = [f"{attrs['name']}: {attrs['prediction']}, f_sky = {attrs['f_sky']:.3g}, {attrs['frame']} frame"]
    text += _spectra(prediction)
    if "signal_to_noise" not in prediction:
        return "\n".join(text)
    total = float(prediction["signal_to_noise_total"])
    text.append(f"  signal to noise of one sky, all maps and modes jointly: {total:.4g}")
    if np.isinf(total):
        text.append("  (maps without noise see the same sky through different beams: nothing hides the beams)")
    each = prediction["signal_to_noise"].to_series().fillna(0.0).nlargest(8)
    for (pair, mode), value in each[each > NEGLIGIBLE * each.max()].items():
        bins = prediction["signal_to_noise_binned"].sel(pair=pair, mode=mode)
        best = bins[int(bins.fillna(0.0).argmax("bin"))]
        at = f"l = {int(best['bin_first'])}-{int(best['bin_last'])}"
        text.append(f"    {pair}  {mode:8s} {value:8.3g}, most of it at {at} ({float(best):.3g})")
    return "\n".join(text)


def _spectra(prediction: xr.Dataset) -> list[str]:
    """Return lines for the bins of the strongest spectra, whole spectra if there is room."""
    text = [
        "  binned means in uK^2 (of the beam: less what noise and masks make), errors of the mean of isotropic skies:"
    ]
    text.append(f"    {'pair':<16} {'mode':<9} {'l':<11} {'mean':>22} {'error':>10} {'of the beam':>22}")
    rows = spectra(prediction, "").assign(beam=spectra(prediction, "_difference")["value"])
    best = strongest(prediction, "")
    best = best[best["sigma"] > NEGLIGIBLE]
    if best.empty:
        return ["  no spectrum with L > 0 differs from zero"]
    shown = max(1, ROWS // prediction.sizes["bin"])
    for pair, mode in zip(best["pair"][:shown], best["mode"][:shown], strict=True):
        for row in rows[(rows["pair"] == pair) & (rows["mode"] == mode)].dropna().itertuples():
            bounds = f"{row.bin_first}-{row.bin_last}"
            mean, beam = _value(row.value, row), _value(row.beam, row)
            text.append(f"    {pair:<16} {mode:<9} {bounds:<11} {mean:>22} {row.error:>10.3g} {beam:>22}")
    if len(best) > shown:
        text.append(f"    and {len(best) - shown} weaker spectra: write all with -o FILE.ecsv")
    return text


def _value(value: complex, row: Any) -> str:
    """Return a coefficient of a row's mode with four digits, without the part that vanishes, but for rounding.

    At M = 0 that is the imaginary part at even parity, and the real one at odd parity, for maps are real.
    """
    real, imaginary = (abs(part) > ROUNDING * abs(value) for part in (value.real, value.imag))
    if row.M == 0:
        real, imaginary = (row.L + row.d) % 2 == 0, (row.L + row.d) % 2 == 1
    if real and imaginary:
        return f"{value:.4g}"
    return f"{value.imag:.4g}j" if imaginary else f"{value.real:.4g}"
