"""Perfect skies at nside 256, prepared by ``mcsim.prepare`` to nside 32, tested against the model that declares it.

    python workflows/preparation/check.py [--skies 200] [--seed 2026] [--lmax L] [--nside 32]
        [--channels 2] [--workers 2] [-o FILE.json]

``--nside`` is that to which they are averaged; ``--channels 1`` leaves V alone. What is simulated of the model is kept:
a run that was killed goes on.

The skies have the model's spectrum up to l = 767 (all that nside 256 holds), its beams and its noise, and a monopole
and dipole of their own. They are averaged, and monopole and dipole outside a mask are subtracted. The global p-values
of the diagnosis must then be uniform although the model simulates its sky only as far as it must. With a ``sky.lmax``
of three times that nside, less one, the model is refused, and the value that it needs is named.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
from scipy import stats

import mcsim
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import asking, batch
from mcsim.diagnosis.api import kept, prepared
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.stats.look_elsewhere import global_test

FINE = 256
PROPOSED = ("beam_ellipticity", "beam_width", "dipole_modulation", "dipole_residual", "noise_level")


def model(lmax: int, nside: int = 32, count: int = 2) -> mcsim.RunConfig:
    """Return a model of V and W band maps at ``nside``, outside a mask that covers 38 % of the sky."""
    mask = (np.abs(healpy.pix2vec(nside, np.arange(12 * nside**2))[2]) > 0.38).astype(float)
    channels = [
        {
            "name": name,
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": fwhm},
            "noise": {"sigma0_uk": sigma0},
            "scan": {"kind": "parallel_transport"},
        }
        # 4 and 6 uK in the mean of the 64 fine pixels of one of nside 32.
        for name, frequency, fwhm, sigma0 in (("V", 61.0, 21.0, 32.0), ("W", 94.0, 13.2, 48.0))[:count]
    ]
    return mcsim.load_config(
        {
            "name": "preparation",
            "sky": {"spectrum": "wmap7", "lmax": lmax},
            "map": {"nside": FINE, "frame": "galactic", "mask": mask},
            "channel": channels,
            "biposh": {"L_max": 2, "lmax": 2 * nside},
            "preparation": [
                {"kind": "degrade", "nside": nside},
                {"kind": "subtract_dipole", "mask": mask},
            ],
        }
    )


def needed(nside: int, count: int) -> tuple[int, str]:
    """Return the sky.lmax that the model needs, and how a lower one is refused."""
    from mcsim.simulation import power

    low = survey(model(3 * nside - 1, nside, count))
    found = power.neglected(low)
    assert found is not None, "the model's sky ends far too low"
    try:
        power.check(low)
    except mcsim.InputError as error:
        return found.needed, str(error)
    raise AssertionError("a model with too low a sky.lmax was not refused")


def skies(run: mcsim.RunConfig, count: int, seed: int):
    """Yield the prepared maps of perfect skies, made with another seed and all the power that nside 256 holds."""
    made = survey(
        replace(
            run,
            preparation=(),
            map=replace(run.map, mask=None),
            sky=replace(run.sky, lmax=3 * FINE - 1),
            ensemble=replace(run.ensemble, seed=seed),
        )
    )
    x, y, z = healpy.pix2vec(FINE, np.arange(12 * FINE**2))
    for number in range(count):
        yield mcsim.prepare([one + 20.0 + 10.0 * x - 5.0 * y + 7.0 * z for one in simulate.maps(made, number)], run)


def main() -> None:
    """Print the p-values' distribution, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skies", type=int, default=200)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--lmax", type=int, help="sky.lmax of the model; default: what it needs")
    parser.add_argument("--nside", type=int, default=32)
    parser.add_argument("--channels", type=int, default=2)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args()
    lmax, refusal = needed(chosen.nside, chosen.channels)
    print(f"refused: {refusal}", flush=True)
    run = model(chosen.lmax or lmax, chosen.nside, chosen.channels)
    analysis = analysis_of(run, [name for name in mcsim.effects() if name not in PROPOSED])
    with (
        batch(chosen.workers) as call,
        asking(call, False, data_vectors, "simulations of the model", kept(run, analysis)) as ask,
    ):
        context = prepared(run, analysis, ask)
    groups = context.null.whiten_groups(context.templates, [one.columns for one in context.candidates])
    pvalues, omnibus, pulls = [], [], []
    for maps in skies(run, chosen.skies, chosen.seed):
        x = analysis.data_vector(maps)
        pvalues.append(global_test(context.null, x, groups, context.calibration).pvalue)
        omnibus.append(context.null.pvalue(x))
        fits = [context.null.fit(x, context.templates[:, list(one.columns)]) for one in context.candidates]
        pulls.append([fit.amplitudes[0] / fit.errors[0] for fit in fits])
    alarms = int(np.sum(np.array(pvalues) <= 0.05))
    low, high = stats.binom.interval(0.95, chosen.skies, 0.05)
    result = {
        "sky_lmax": run.sky.lmax,
        "skies": chosen.skies,
        "simulations": len(context.ensemble.simulations),
        "elements": len(analysis.elements),
        "ks_p_value": float(stats.kstest(pvalues, "uniform").pvalue),
        "ks_p_value_of_chi2": float(stats.kstest(omnibus, "uniform").pvalue),
        "false_alarms_at_5_percent": alarms,
        "interval": [int(low), int(high)],
        "smallest": float(min(pvalues)),
        "mean_pulls": dict(
            zip((one.label for one in context.candidates), np.mean(pulls, axis=0).tolist(), strict=True)
        ),
        "p_values": pvalues,
    }
    print({key: value for key, value in result.items() if key != "p_values"})
    if chosen.output is not None:
        chosen.output.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
