"""Command line: thin calls of public functions.

Exit codes: 0 done, 1 failed realizations, 2 bad input, 130 interrupted.
"""

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from mcsim.cli import ensembles
from mcsim.cli.common import Config, Png, Simulations, Workers, interrupt_once, out, save
from mcsim.errors import InputError, RunError

app = typer.Typer(
    name="mcsim",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line; bad input ends in one sentence and exit code 2."""
    try:
        app()
    except (InputError, RunError) as error:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"mcsim: {error}", markup=False)
        sys.exit(2 if isinstance(error, InputError) else 1)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        out.print(f"mcsim {version('mcsim')}", markup=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version and exit.")
    ] = False,
) -> None:
    """Tell whether a measured isotropy violation is made by the instrument."""


for _command in (
    ensembles.run,
    ensembles.merge,
    ensembles.info,
    ensembles.plot,
    ensembles.predict,
    ensembles.maps,
    ensembles.prepare,
):
    app.command()(_command)


@app.command()
def fit(
    data: Annotated[str, typer.Argument(metavar="DATA", help="Store, or ECSV table of binned spectra.")],
    config: Config,
    model: Annotated[
        list[str] | None, typer.Option("--model", help="constant, linear, spline or orientation; may be repeated.")
    ] = None,
    ell_min: Annotated[int, typer.Option(min=0, help="First ell of the data.")] = 2,
    ell_max: Annotated[int | None, typer.Option(min=2, help="Last ell of the data.")] = None,
    pair: Annotated[str | None, typer.Option(help="Pair of maps; default: the only one.")] = None,
    mode: Annotated[
        list[str] | None, typer.Option("--mode", help="Such as L2M0d0; may be repeated; default: A20 at d = 0 and 2.")
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(help="plain, or difference to the circular-beam controls; default: difference where known."),
    ] = None,
    order: Annotated[
        str, typer.Option(help="leading or exact (all orders in the beam); auto: exact where the data tell them apart.")
    ] = "auto",
    covariance: Annotated[
        Path | None, typer.Option(metavar="STORE", help="Take the covariance of one of its realizations.")
    ] = None,
    knots: Annotated[int, typer.Option(min=2, help="Of a spline.")] = 4,
    each: Annotated[bool, typer.Option("--each", help="Fit every realization of a store too, for the pulls.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    output: Png = None,
) -> None:
    """Fit an effective beam, b_l2 f_l with f_l = alpha or alpha + beta l, to measured or simulated spectra."""
    from mcsim import beamfit
    from mcsim.ensemble.expectation import survey_of
    from mcsim.plot.fit import fit_figure

    nthreads = os.cpu_count() or 1
    span = None if ell_max is None and ell_min == 2 else (ell_min, ell_max if ell_max is not None else 1 << 30)
    selection = beamfit.Selection(tuple(mode or beamfit.QUADRUPOLE), span, kind, pair)  # type: ignore[arg-type]
    survey = survey_of(config, nthreads)
    measured = beamfit.measurement(data, survey, selection, covariance)
    names = model or ["constant", "linear"]
    fits = beamfit.fit_models(measured, survey, names, knots=knots, order=order, nthreads=nthreads)  # type: ignore[arg-type]
    if each:
        fits = [beamfit.fit_each(one) for one in fits]
    if as_json:
        print(json.dumps([one.to_dict() for one in fits], indent=2))
    else:
        out.print(beamfit.report(fits), markup=False)
    save(fit_figure(fits), output or Path("fit.png"))


@app.command()
def beam(
    source: Annotated[str, typer.Argument(metavar="BEAM", help="Beam map or b_lm (FITS), or a CONFIG.")],
    lmax: Annotated[int, typer.Option(min=2, max=8192, help="Degree of the coefficients.")] = 2048,
    m_max: Annotated[int | None, typer.Option(min=0, help="Order; default: chosen from the beam.")] = None,
    pixel_deg: Annotated[
        float | None, typer.Option(help="Side of a pixel of a beam map; default: its header's.")
    ] = None,
    output: Png = None,
) -> None:
    """Print a beam's solid angle, widths, B_l and b_lm; draw it."""
    from mcsim.plot.look import look_at_beams

    for number, look in enumerate(look_at_beams(source, lmax, m_max, pixel_deg)):
        out.print(look.text, markup=False)
        target = output or Path("beam.png")
        save(look.figure, target if number == 0 else target.with_stem(f"{target.stem}-{look.name}"))


@app.command()
def scan(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="Scan model: a packaged name such as wmap, or TOML.")],
    nside: Annotated[int, typer.Option(help="Resolution of the moments.")] = 256,
    smax: Annotated[int, typer.Option(min=2, help="Largest s of the moments w_s.")] = 4,
    frame: Annotated[str, typer.Option(help="ecliptic, galactic or equatorial.")] = "ecliptic",
    sample_period_s: Annotated[float | None, typer.Option(help="Time between samples; default: the model's.")] = None,
    line_of_sight: Annotated[str | None, typer.Option(help="One of the model's lines of sight.")] = None,
    output: Png = None,
) -> None:
    """Print the hits, the orientation moments and the three factors of a scan; draw them."""
    from mcsim.plot.look import look_at_scan

    look = look_at_scan(model, nside, smax, frame, sample_period_s, line_of_sight)
    out.print(look.text, markup=False)
    save(look.figure, output or Path(f"scan-{look.name}.png"))


@app.command()
def diagnose(
    model: Config,
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA", help="Folder with CHANNEL.fits or CHANNEL_SPLIT.fits, or an ECSV table of measured spectra."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for verdict and report.")],
    case: Annotated[str | None, typer.Option(help="Name of the case; default: that of the model.")] = None,
    without: Annotated[list[str] | None, typer.Option(metavar="EFFECT", help="Do not propose it; repeatable.")] = None,
    simulations: Simulations = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Local processes; default: the configuration's.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say simulations, memory and time; simulate none.")
    ] = False,
) -> None:
    """Test maps against a model, and find the effect that the model lacks: where, how large, and if adding it helps."""
    from mcsim.diagnosis.api import diagnose as judge
    from mcsim.diagnosis.words import summary

    if dry_run:
        from mcsim.diagnosis.api import describe

        out.print(describe(model, without or (), simulations, workers), markup=False)
        return
    interrupt_once()
    found = judge(
        model,
        data,
        output,
        case=case,
        without=without or (),
        simulations=simulations,
        workers=workers,
        quiet=False,
    )
    out.print("\n".join(summary(found, output)), markup=False, highlight=False, soft_wrap=True)


challenge = typer.Typer(help="Benchmark the diagnosis on effects that are drawn and sealed.", no_args_is_help=True)
app.add_typer(challenge, name="challenge")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the challenge.")]
Target = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to fill.")]


@challenge.command("make")
def challenge_make(
    model: Config,
    output: Target,
    cases: Annotated[int, typer.Option(min=1, help="Number of cases.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws; keep it as secret as the keys.")] = 0,
    sampled_share: Annotated[float, typer.Option(min=0.0, max=1.0, help="Share of maps made sample by sample.")] = 0.5,
    inventions: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Python file with effects that no library has.")
    ] = None,
    simulations: Simulations = None,
    workers: Workers = None,
) -> None:
    """Draw effects, make the maps of the cases, seal the keys."""
    from mcsim import config
    from mcsim.benchmark.folder import Settings
    from mcsim.benchmark.make import make

    interrupt_once()
    file = None if inventions is None else str(inventions)
    shared = Settings(config.load(model), sampled_share=sampled_share, out_of_library=file, simulations=simulations)
    make(shared, output, cases, seed, workers=workers, quiet=False)


@challenge.command("run")
def challenge_run(folder: Folder, workers: Workers = None) -> None:
    """Diagnose all cases that have no verdict."""
    from mcsim.benchmark.run import run as diagnose_all

    interrupt_once()
    out.print(f"{diagnose_all(folder, workers=workers, quiet=False)} cases diagnosed", markup=False)


@challenge.command("score")
def challenge_score(folder: Folder, workers: Workers = None) -> None:
    """Open the keys and score the verdicts."""
    from mcsim.benchmark import report, score

    out.print("\n".join(report.lines(score.score(folder, workers=workers, quiet=False))), markup=False)


@challenge.command("draws")
def challenge_draws(
    model: Config,
    output: Target,
    number: Annotated[int, typer.Option(min=1, help="Number of draws.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    simulations: Simulations = None,
    workers: Workers = None,
) -> None:
    """Draw and score compressed data vectors, without maps."""
    from mcsim import config
    from mcsim.benchmark import report, score
    from mcsim.benchmark.folder import Settings

    shared = Settings(config.load(model), simulations=simulations)
    found = score.score_draws(shared, output, number, seed, workers=workers, quiet=False)
    out.print("\n".join(report.lines(found)), markup=False)


@app.command()
def effects(name: Annotated[str | None, typer.Argument(metavar="EFFECT", help="Only this one.")] = None) -> None:
    """List the library of effects: what a run can add and a diagnosis can find."""
    from mcsim import systematics as library

    known = [library.get(name).name] if name is not None else None
    for row in library.describe():
        if known is not None and row["name"] not in known:
            continue
        parameters = ", ".join(f"{key} = {value!r}" for key, value in row["parameters"].items())
        out.print(f"{row['name']} ({row['scope']}; amplitude in {row['unit']})", style="bold", markup=False)
        out.print(f"  parameters  {parameters}", markup=False)
        for key in ("cause", "signature", "source"):
            out.print(f"  {key:<11} {row[key]}", markup=False)


@app.command()
def bench(
    nside: Annotated[int, typer.Option(help="Resolution of the maps.")] = 512,
    lmax: Annotated[int, typer.Option(min=2, help="Degree of the analysis.")] = 1024,
    repeats: Annotated[int, typer.Option(min=1, help="Pairs of timings.")] = 5,
) -> None:
    """Measure this machine: a realization over the transforms that it needs, workers, moments."""
    from mcsim.ensemble.bench import bench as measure

    for line in measure(nside, lmax, repeats):
        out.print(line, markup=False)


@app.command()
def config(
    name: Annotated[
        str | None, typer.Argument(metavar="CONFIG", help="Check this configuration and print it resolved.")
    ] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of the TOML file.")] = False,
) -> None:
    """Check a configuration, or print the schema of all."""
    from mcsim import config as config_

    if schema:
        print(json.dumps(config_.json_schema(), indent=2))
    elif name is not None:
        from mcsim.simulation.channels import check_effects

        loaded = config_.load(name)
        check_effects(loaded)
        print(json.dumps({"digest": config_.digest(loaded), **config_.resolved(loaded)}, indent=2))
    else:
        raise InputError("Nothing was asked for; give a configuration to check, or --schema.")
