"""Draw what check.py found, and what imbalance and stopping early do to a map.

python workflows/diagnosis/differencing/figure.py FILE.json [...] -o PICTURE.png
"""

import argparse
import json
from pathlib import Path

import healpy
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from check import PUT_IN, model  # type: ignore[attr-defined]  # there are several of this name

from mcsim import systematics
from mcsim.simulation import convolve, differencing, simulate
from mcsim.simulation.survey import survey


def maps() -> list[tuple[str, np.ndarray]]:
    """Return the maps of W1's first half year at nside 64 of an imbalance, and of stopping after eight iterations."""
    shared = survey(model(64))
    channel = shared.channels[1]
    sky = convolve.circular_map(simulate.draw_sky(shared, 0), channel.response, 64)
    return [
        ("dipole, imbalance 0.001 [µK]", differencing.of_dipole(channel, 1e-3)[0]),
        ("sky not reached after 8 iterations [µK]", differencing.not_converged(channel, channel.maps[0], sky)),
    ]


def main() -> None:
    """Draw all panels."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    chosen = parser.parse_args()
    results = [json.loads(path.read_text()) for path in chosen.files]
    figure = plt.figure(figsize=(10.0, 7.0))
    for place, (title, map_uk) in enumerate(maps()):
        healpy.mollview(
            map_uk, fig=figure.number, sub=(2, 2, place + 1), title=title, cmap="RdBu_r", notext=True, format="%.2g"
        )
    left, right = (figure.add_axes((x, 0.08, 0.4, 0.36)) for x in (0.07, 0.57))
    for result in results:
        p = np.sort(result["null"]["p_values"])
        left.step(p, np.arange(1, p.size + 1) / p.size, where="post", label=f"nside {result['nside']}, {p.size} skies")
    left.plot([0, 1], [0, 1], "k:", lw=0.8)
    left.set(xlabel="p-value where nothing is wrong", ylabel="share of skies")
    left.legend(frameon=False)
    for result, marker in zip(results, "osD", strict=False):
        for place, name in enumerate(PUT_IN):
            own = [one for one in result["cases"] if one["effect"] == name and len(one["found"]) == 1]
            own = [one for one in own if one["found"][0]["name"] == name]
            at = place + np.linspace(-0.3, 0.3, len(own) + 2)[1:-1]
            ratio = [one["found"][0]["amplitude"] / one["amplitude"] for one in own]
            error = [one["found"][0]["sigma"] / one["amplitude"] for one in own]
            right.errorbar(at, ratio, error, fmt=marker, ms=3, lw=0.8, color=f"C{place}")
        right.plot([], [], marker, ms=4, color="0.3", label=f"one map, nside {result['nside']}")
    right.legend(frameon=False, loc="upper right")
    right.axhline(1.0, color="k", lw=0.8, ls=":")
    right.set_xticks(range(len(PUT_IN)), [systematics.get(name).label().replace(" ", "\n") for name in PUT_IN])
    right.set_ylabel("fitted amplitude / amplitude put in")
    figure.savefig(chosen.output, dpi=110)


if __name__ == "__main__":
    main()
