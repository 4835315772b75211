"""Controls of the diagnosis of the WMAP-7 maps: perfect skies at nside 512 and l <= 1000, prepared like the maps.

    python workflows/diagnosis/wmap7-maps/control.py FOLDER --skies 34

Reads $MCSIM_DATA as model.toml does, writes the prepared maps to FOLDER, and prints verdict and p-value of each.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import mcsim

NSIDE, LMAX, SEED = 512, 1000, 4242


def main() -> None:
    """Print a line for each sky; none may show a gap more often than the level of the test."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--skies", type=int, default=34)
    arguments = parser.parse_args()
    model = mcsim.load_config(Path(__file__).with_name("model.toml"))
    real = replace(
        model,
        sky=replace(model.sky, lmax=LMAX),
        map=replace(model.map, nside=NSIDE),
        ensemble=replace(model.ensemble, realizations=arguments.skies, seed=SEED),
    )
    for folder in mcsim.write_maps(real, arguments.folder):
        found = mcsim.diagnose(model, folder)
        print(f"{folder.name}  {found.kind}  p = {found.test.pvalue:.3g}", flush=True)


if __name__ == "__main__":
    main()
