"""Print how often effects in maps of differencing scans are detected and named, from what check.py wrote.

python workflows/diagnosis/differencing/rates.py FILE.json [...]
"""

import json
import sys
from pathlib import Path

import numpy as np

from mcsim.stats.intervals import share


def main() -> None:
    """Print a block for each effect and amplitude."""
    cases = [one for path in sys.argv[1:] for one in json.loads(Path(path).read_text())["cases"]]
    for name, amplitude in sorted({(one["effect"], one["amplitude"]) for one in cases}):
        own = [one for one in cases if (one["effect"], one["amplitude"]) == (name, amplitude)]
        print(f"{name}, {amplitude:.4g}")
        for what, right in (
            ("p <= 0.05", [one["p_value"] <= 0.05 for one in own]),
            ("named alone", [one["sets"] == [[f"{name} W1"]] for one in own]),
            ("a wrong name", [any(said != [f"{name} W1"] for said in one["sets"][:1]) for one in own]),
        ):
            found = share(what, right)
            print(f"    {what}: {sum(right)} of {len(right)} [{found.low:.3f}, {found.high:.3f}]")
        fits = [one["found"][0] for one in own if one["sets"] == [[f"{name} W1"]]]
        pulls = np.array([(one["amplitude"] - amplitude) / one["sigma"] for one in fits])
        if pulls.size > 1:
            mean, width, count = np.mean(pulls), np.std(pulls, ddof=1), pulls.size
            print(
                f"    pulls: mean {mean:.2f} +- {count**-0.5:.2f}, width {width:.2f} +- {(2 * count - 2) ** -0.5:.2f}"
            )


if __name__ == "__main__":
    main()
