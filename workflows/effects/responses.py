"""Response of maps to every effect: the default route against the survey made sample by sample, and a picture of all.

    python workflows/effects/responses.py INSTRUMENT [-o FOLDER] [--effects NAME ...]

INSTRUMENT is a folder with ``scan.toml`` (how the survey was pointed), ``cl_tt.txt`` (the sky's spectrum) and the
moments ``moments_W1_half1.fits`` and ``moments_W1_half2.fits``: nside 128, a year at 2 s. FOLDER takes the responses
(``responses.npz``), so that the pictures can be drawn again without them: ``effects.png``, and
``effects-on-request.png`` of those that a diagnosis proposes on request. About 6 minutes on two cores, and 70 s of one.
"""

import argparse
import os
import textwrap
from pathlib import Path
from typing import Any

import healpy
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import ticker
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import healpix
from mcsim.support import resources

NSIDE, LMAX, SHOWN_LMAX = 128, 384, 256
PARAMETERS: dict[str, dict[str, Any]] = {
    "beam_ellipticity": {"amplitude": 0.1, "angle_deg": 20.0},
    "beam_coma": {"amplitude": 0.02, "angle_deg": 20.0},
    "beam_sidelobe": {"amplitude": 0.001, "quadrupole": 0.5},
    "beam_width": {"amplitude": 0.02},
    "calibration": {"amplitude": 0.003},
    "beam_noncircularity": {"amplitude": 1.0},
    "pointing_offset": {"amplitude": 2.0, "angle_deg": 70.0},
    "time_constant": {"amplitude": 0.02},
    "gain_drift": {"amplitude": 0.001, "phase_deg": 30.0},
    "dipole_residual": {"amplitude": 3.0, "lon_deg": 20.0, "lat_deg": 30.0},
    "monopole_residual": {"amplitude": 3.0},
    "dipole_modulation": {"amplitude": 0.07, "lon_deg": 20.0, "lat_deg": 30.0},
    "quadrupole_modulation": {"amplitude": 0.05, "components": [1.0, 0.2, 0.3, 0.4, 0.5]},
    "boost": {"amplitude": 0.00123, "lon_deg": 264.0, "lat_deg": 48.0},
    "foreground_residual": {"amplitude": 5.0},
    "point_sources": {"amplitude": 0.002},
    "spectrum": {"amplitude": 0.05, "bands": [0.0, 1.0, 0.0, -1.0, 0.0, 0.0]},
    "pixelization": {"amplitude": 1.0},
    "noise_anisotropy": {"amplitude": 0.2},
    "noise_level": {"amplitude": 0.1},
    "orientation_averaging": {"amplitude": 1.0},
    "transmission_imbalance": {"amplitude": 0.005},
    "mapmaking_convergence": {"amplitude": 15.0},
    "sidelobe_pickup": {"amplitude": 0.002},
    "nonlinearity": {"amplitude": 0.001},
    "gain_spin": {"amplitude": 0.001, "phase_deg": 30.0},
    "bandpass_mismatch": {"amplitude": 3.0},
    "orbital_dipole": {"amplitude": 0.01, "phase_deg": 30.0},
    "spin_synchronous_offset": {"amplitude": 1.0, "phase_deg": 30.0},
    "pointing_jitter": {"amplitude": 25.0},
    "lensing": {"amplitude": 1.0},
    "excess_noise": {"amplitude": 0.001},
}
NOISE = ("noise_anisotropy", "noise_level")
UNIFORM = dict.fromkeys(NOISE, "a change of the variance:\nno mean response") | {
    "monopole_residual": "no power above ℓ = 0"
}
DIFFERENCING = ("transmission_imbalance", "mapmaking_convergence")

Map = NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("instrument", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("effects"))
    parser.add_argument("--effects", nargs="*", choices=sorted(PARAMETERS), default=list(PARAMETERS))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    store = arguments.output / "responses.npz"
    known = dict(np.load(store)) if store.exists() else {}
    plain: dict[str | None, tuple[list[Map], list[Map]]] = {}
    print(f"{'effect':24s} {'rms, uK':>9s} {'cosine':>8s} {'l < 256':>8s} {'sampled/default':>16s}")
    for name in arguments.effects:
        if name not in known:
            known[name] = response(name, arguments, plain)
            np.savez(store, **known)
        report(name, known[name])
    found = {name: known[name] for name in PARAMETERS if name in known}
    for proposed, picture in ((True, "effects.png"), (False, "effects-on-request.png")):
        shown = {name: maps for name, maps in found.items() if systematics.get(name).proposed is proposed}
        if shown:
            draw(shown, arguments.output / picture, TITLE + ROUTE if proposed else TITLE)


def response(name: str, arguments: argparse.Namespace, plain: dict[str | None, tuple[list[Map], list[Map]]]) -> Map:
    """Maps with the effect less those without, of the default route and, where it can, of the sampled one."""
    if name in NOISE:
        effect = systematics.build(name, PARAMETERS[name])
        factor = effect.noise(prepared(name, arguments).channels[0].site)
        return np.array([factor - 1.0])
    if name in DIFFERENCING or name in ("orientation_averaging", "excess_noise"):
        return simulate.maps(prepared(name, arguments), 0)[:1] - simulate.maps(prepared(None, arguments, name), 0)[:1]
    like = name if name == "beam_noncircularity" else None
    if like not in plain:
        without = prepared(None, arguments, like)
        plain[like] = list(simulate.maps(without, 0, 2)), time_ordered(without)
    changed, (default_without, true_without) = prepared(name, arguments), plain[like]
    default = [m - p for m, p in zip(simulate.maps(changed, 0, 2), default_without, strict=True)]
    true = [m - p for m, p in zip(time_ordered(changed), true_without, strict=True)]
    return np.array([*default, *true])


def time_ordered(of: Survey) -> list[Map]:
    return [map_uk for _, map_uk in sampled.maps(of, 0, nthreads=2, epsilon=1e-8)]


def prepared(name: str | None, arguments: argparse.Namespace, like: str | None = None) -> Survey:
    """The survey with an effect, or without any, of the kind of beam and scan that the effect ``like`` needs."""
    folder, kind = arguments.instrument.resolve(), like or name
    nside, lmax, splits = NSIDE, LMAX, ["half1", "half2"]
    beam: dict[str, Any] = {"kind": "gaussian", "fwhm_arcmin": 44.0}
    scan: dict[str, Any] = {
        "kind": "moments",
        "path": f"{folder}/moments_W1_{{split}}.fits",
        "model": f"{folder}/scan.toml",
    }
    parameters = dict(PARAMETERS[name]) if name else {}
    if kind == "orientation_averaging":
        beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 47.2, "fwhm_minor_arcmin": 41.0}
        scan = {"kind": "parallel_transport", "psi0_deg": 90.0}
        if name:
            parameters["model"] = slow(arguments.output)
    if kind == "beam_noncircularity":
        beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 47.2, "fwhm_minor_arcmin": 41.0, "m_max": 0}
    if kind in DIFFERENCING:
        nside, lmax, splits = 32, 64, []
        beam = {"kind": "gaussian", "fwhm_arcmin": 200.0}
        scan = {"kind": "differencing", "model": "wmap", "pair": "WMAP", "sample_period_s": 8.0}
    table: dict[str, Any] = {
        "schema": 1,
        "name": "response",
        "sky": {"spectrum": f"{folder}/cl_tt.txt", "lmax": lmax, "dipole_uk": 3364.5},
        "map": {"nside": nside, "splits": splits},
        "channel": [{"name": "W1", "frequency_ghz": 94.0, "beam": beam, "scan": scan}],
        "biposh": {"L_max": 2, "lmax": min(lmax, SHOWN_LMAX)},
        "ensemble": {"realizations": 1, "seed": 1},
    }
    if name is not None:
        channel = {"channel": "W1"} if systematics.get(name).scope == "channel" else {}
        table["effect"] = [{"name": name, **channel, **parameters}]
    return survey(config.load(table), nthreads=2)


def slow(folder: Path) -> str:
    """WMAP's scan with a sample every 2 s: as good for orientation moments, and 40 times as fast."""
    text = resources.scan_model("wmap").read_text().replace("sample_period_s = 0.0512", "sample_period_s = 2.0")
    path = folder / "wmap_2s.toml"
    path.write_text(text)
    return os.fspath(path.resolve())


def report(name: str, maps: Map) -> None:
    if len(maps) < 4:
        print(f"{name:24s} {np.sqrt(np.mean(maps[0] ** 2)):9.4f}   default route only")
        return
    for half, (default, true) in enumerate(zip(maps[:2], maps[2:], strict=True), start=1):
        pairs = [(default, true)]
        coefficients = [healpix.analysis(m, SHOWN_LMAX, 1) for m in (default, true)]
        weight = np.where(np.arange(coefficients[0].size) <= SHOWN_LMAX, 1.0, 2.0)
        pairs.append(tuple(np.concatenate([weight**0.5 * c.real, weight**0.5 * c.imag]) for c in coefficients))
        cosines = [x @ y / np.sqrt((x @ x) * (y @ y)) for x, y in pairs]
        print(
            f"{name:24s} {np.std(true):9.4f} {cosines[0]:8.5f} {cosines[1]:8.5f} "
            f"{default @ true / (default @ default):16.5f}   half{half}",
            flush=True,
        )


def draw(found: dict[str, Map], path: Path, title: str) -> None:
    """A map of the response of the first half and the spectra of both routes, for every effect."""
    columns = 6 if len(found) > 12 else 5
    rows = -(-len(found) // columns)
    figure = plt.figure(figsize=(2.8 * columns, 3.6 * rows), layout="constrained")
    figure.suptitle(title, fontsize=12)
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[1.0, 0.62] * rows)
    for place, (name, maps) in enumerate(found.items()):
        row, column = divmod(place, columns)
        above = figure.add_subplot(grid[2 * row, column], projection="mollweide")
        effect = systematics.build(name, PARAMETERS[name])
        size = textwrap.fill(effect.format_amplitude(effect.amplitude), 36)
        above.set_title(f"{effect.label()}\n{size}", fontsize=9)
        sky(above, name, maps)
        below = figure.add_subplot(grid[2 * row + 1, column])
        spectra(below, name, maps)
        if place + columns >= len(found):
            below.set_xlabel(r"multipole $\ell$", fontsize=8)
        if column == 0:
            below.set_ylabel(r"$\ell(\ell+1)C_\ell/2\pi$  [$\mu$K$^2$]", fontsize=8)
    figure.savefig(path, dpi=80)
    plt.close(figure)


TITLE = (
    "Response of a channel to every effect: W1, 44′, the first half of a year, ecliptic. Below each map its spectrum, "
    "in the default route (line)\nand sample by sample (dots)."
)
ROUTE = " Scans of another kind (no dots) are in the default route alone"


def sky(axes: Any, name: str, maps: Map) -> None:
    shown = healpy.smoothing(maps[0], fwhm=np.deg2rad(1.5)) if len(maps) == 4 else maps[0]
    reach = np.percentile(np.abs(shown - (0.0 if name in UNIFORM else shown.mean())), 99.0)
    lon, lat = np.linspace(np.pi, -np.pi, 501), np.linspace(-np.pi / 2, np.pi / 2, 251)
    middle_lon, middle_lat = (lon[1:] + lon[:-1]) / 2, (lat[1:] + lat[:-1]) / 2
    pixels = healpy.ang2pix(healpy.npix2nside(shown.size), np.pi / 2 - middle_lat[:, None], middle_lon[None, :])
    # Longitude grows to the left, as on the sky seen from inside.
    image = axes.pcolormesh(-lon, lat, shown[pixels], cmap="RdBu_r", vmin=-reach, vmax=reach, rasterized=True)
    axes.set_xticks([])
    axes.set_yticks([])
    bar = axes.figure.colorbar(image, ax=axes, orientation="horizontal", shrink=0.7, aspect=30, pad=0.03)
    bar.set_ticks([-reach, 0.0, reach], labels=[f"{value:.2g}" for value in (-reach, 0.0, reach)])
    bar.set_label("relative change of the variance" if name in NOISE else r"$\mu$K", fontsize=7)
    bar.ax.tick_params(labelsize=7)


def spectra(axes: Any, name: str, maps: Map) -> None:
    if name in UNIFORM:
        axes.text(0.5, 0.5, UNIFORM[name], ha="center", va="center", fontsize=8)
        axes.set_axis_off()
        return
    lmax = min(SHOWN_LMAX, 2 * healpy.npix2nside(maps.shape[1]))
    ell = np.arange(1, lmax + 1)
    scale = ell * (ell + 1) / (2.0 * np.pi)
    power = [scale * healpy.alm2cl(healpix.analysis(m, lmax, 1))[1:] for m in maps[[0, -2] if len(maps) == 4 else [0]]]
    axes.loglog(ell, power[0], color="C0", lw=1.0)
    if len(power) > 1:
        axes.loglog(ell[::4], power[1][::4], ".", color="C3", ms=2.5)
    axes.set_ylim(power[0].max() * 1e-6, power[0].max() * 3.0)
    axes.yaxis.set_major_locator(ticker.LogLocator(numticks=4))
    axes.tick_params(labelsize=7)


if __name__ == "__main__":
    main()
