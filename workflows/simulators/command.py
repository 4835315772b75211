"""The command line that the simulators have in common."""

import argparse
from collections.abc import Callable

import inputs


def main(description: str | None, simulate: Callable[[inputs.Inputs], inputs.Maps]) -> None:
    """Read a run's TOML, simulate it, write its maps."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="run configuration")
    parser.add_argument("folder", help="for the maps")
    parser.add_argument("--realization", type=int, default=0)
    given = parser.parse_args()
    read = inputs.of(given.model, given.realization)
    inputs.write(given.folder, simulate(read), read.frame)
