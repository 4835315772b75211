"""A picture of a reconstructed structure: what it adds to a map, and its profile in l."""

from typing import Any

import healpy
import numpy as np
from matplotlib.figure import Figure

from mcsim.plot.sky import mollweide
from mcsim.reconstruction.result import Reconstructed

BLUE = "#0072b2"


def structure_figure(found: Reconstructed, frame: str) -> Figure | None:
    """Draw map and profile of a structure, those of the two that it has; None if it has neither.

    ``frame`` is that of the maps.
    """
    panels = [name for name, one in (("map", found.picture), ("profile", found.profile)) if one]
    if not panels:
        return None
    figure = Figure(figsize=(1.0 + 4.6 * len(panels), 3.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        if name == "map":
            values = np.array(found.picture)
            values = np.where(values == healpy.UNSEEN, np.nan, values)
            reach = float(np.nanmax(np.abs(values))) or 1.0
            style: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -reach, "vmax": reach, "interpolation": "nearest"}
            shown = mollweide(axes, values, 600, **style)
            axes.set_title(f"{found.picture_of.replace(':', ' ')}, {frame}", fontsize=9, parse_math=False)
            figure.colorbar(shown, ax=axes, orientation="horizontal", shrink=0.7, label="µK")
            continue
        low, high, size, sigma = np.array(found.profile).T
        middle = np.sqrt(np.maximum(low, 1.0) * np.maximum(high, 1.0))
        reach_x = np.stack([middle - np.maximum(low, 1.0) + 0.3, high - middle + 0.3])
        axes.errorbar(middle, size, sigma, reach_x, fmt="o", color=BLUE, capsize=3, markersize=4)
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set_xscale("log")
        ticks = [*map(int, low), int(high[-1])]
        axes.set_xticks(ticks, list(map(str, ticks)))
        axes.minorticks_off()
        axes.set_xlabel("ℓ", fontsize=9)
        signal = "power of the signal" if found.index is None else "$C_\\ell$ at 94 GHz, µK²"
        axes.set_ylabel(PROFILE.get(found.stage, signal), fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


PROFILE = {
    "beam": "change of $b_{\\ell m}$ over\n$b_{\\ell 0}\\,(\\ell/\\ell_\\mathrm{max})^m$",
    "power": "relative change of the power",
    "noise": "power of the noise, over its error²",
}
"""What a profile is of, by stage."""
