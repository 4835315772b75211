"""Estimate the orders of the W1 beam in the frame of its scan from masked noisy maps, and hold them against the beam.

python workflows/filter/beam_modes.py [--realizations 24] [--json beam-modes.json]
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import mcsim
from mcsim.simulation import simulate
from mcsim.simulation.beam_modes import BeamModes
from mcsim.simulation.survey import survey

HERE = Path(__file__).parent
CHANNEL, ORDERS, WIDTH, PROBES = "W1", 2, 50, 100


def main() -> None:
    """Estimate from paired skies, compare with the beam, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--realizations", type=int, default=24)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    run = mcsim.load_config(HERE / "filtered.toml").of_channels(CHANNEL)
    round_beam = replace(run.channels[0], beam=replace(run.channels[0].beam, m_max=0))
    shared, control = survey(run), survey(replace(run, channels=(round_beam,)))
    (channel,), lmax = shared.channels, shared.config.sky.lmax
    filter_, moments = shared.filtering.filters[0], channel.maps[0].moments
    modes, fine = (BeamModes(filter_, moments, ORDERS, width) for width in (WIDTH, 1))
    # Numbers of bins are sums of those of single degrees.
    probes = [fine.probe(number) for number in range(PROBES)]
    pairs = np.array([fine.products(a, b) + fine.products(b, a) for i, a in enumerate(probes) for b in probes[:i]])
    every = np.array([fine.spectra(row) for row in pairs])  # (pair, order, degree)
    starts = modes.first
    bins = np.add.reduceat(np.nan_to_num(every), starts, axis=-1)
    row = np.concatenate([bins.real.reshape(len(pairs), -1), bins.imag.reshape(len(pairs), -1)], axis=1)
    beta = channel.beam.blm[1 : ORDERS + 1, : lmax + 1] / channel.beam.blm[0, : lmax + 1]
    true = np.sum(np.nan_to_num(every.conj() * beta).real, axis=(1, 2))
    fisher = row.T @ row / (2.0 * len(pairs))
    # Hartlap, Simon & Schneider 2007, A&A 464, 399, eq. 17
    inverse = (len(pairs) - len(fisher) - 1) / len(pairs) * np.linalg.inv(fisher)
    expected = np.linalg.solve(fisher, row.T @ true) / (2.0 * len(pairs))
    found, alone = [], []
    for r in range(arguments.realizations):
        one, other = (modes.score(simulate.maps(each, r)[0]) for each in (shared, control))
        found.append(inverse @ (one - other))
        alone.append(inverse @ other)
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    normalisation = np.sqrt((np.diag(inverse) * (expected @ fisher @ expected) + expected**2) / len(pairs))
    pull = (mean - expected) / np.hypot(error, normalisation)
    sigma, scatter = np.sqrt(np.diag(inverse)), np.std(alone, axis=0, ddof=1)
    rms = np.sqrt(np.mean(pull**2))
    print(f"{row.shape[1]} numbers, {len(found)} skies: pulls rms {rms:.2f}, largest {abs(pull).max():.1f}")
    print(f"variance of circular skies over that of the Fisher matrix: {np.mean((scatter / sigma) ** 2):.2f}")
    kinds = [(part, s) for part in ("Re", "Im") for s in range(1, ORDERS + 1)]
    names = [f"{part} b_{s}/b_0, l >= {first}" for part, s in kinds for first in starts]
    print("mean, error, error of the normalisation, beam, error of one sky")
    for name, *numbers in zip(names, mean, error, normalisation, expected, sigma, strict=True):
        print(f"  {name:24s}", *(f"{value:9.5f}" for value in numbers))
    if arguments.json:
        result = {"name": names, "mean": mean.tolist(), "error": error.tolist(), "expected": expected.tolist()}
        result |= {"sigma": sigma.tolist(), "normalisation": normalisation.tolist(), "pull": pull.tolist()}
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
