"""Command line: thin calls of public functions.

Exit codes: 0 done, 1 failed realizations, 2 bad input, 130 interrupted.
"""

import json
import os
import sys
import warnings
from dataclasses import fields, replace
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from mcsim.cli import ensembles
from mcsim.cli.common import (
    Command,
    Config,
    Group,
    Including,
    Png,
    Scheduler,
    Simulations,
    Workers,
    chosen,
    picture,
    processes,
    save,
)
from mcsim.errors import InputError, RunError
from mcsim.support.folders import is_full, reason
from mcsim.support.loading import loaded

app = typer.Typer(
    name="mcsim",
    cls=Group,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line; bad input ends in one sentence and exit code 2, a full disk or memory in exit code 1."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # of a terminal that may lack ± and µ
            stream.reconfigure(errors="replace")
    warnings.showwarning = _warned
    _said.clear()
    try:
        app()
    except (InputError, RunError) as error:
        print(f"mcsim: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, InputError) else 1)
    except MemoryError as error:
        print(f"mcsim: not enough memory ({error}); lower nside, lmax, smax or the workers.", file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        if error.errno is None and not is_full(error):  # no word of the system's
            raise
        what = error.filename or "the output"
        print(f"mcsim: {what}: {reason(error)}; check its permissions and the space on its disk.", file=sys.stderr)
        sys.exit(1)


_of_python = warnings.showwarning
_said: set[str] = set()


def _warned(message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None) -> None:
    """Say a warning of mcsim's own once, in a sentence, and any other one as Python does."""
    if Path(filename).is_relative_to(Path(__file__).parents[1]):
        if str(message) not in _said:
            print(f"mcsim: {message}", file=sys.stderr)
        _said.add(str(message))
    else:
        _of_python(message, category, filename, lineno, file, line)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"mcsim {version('mcsim')}")
        raise typer.Exit


Version = Annotated[bool, Option("--version", callback=_version, is_eager=True, help="Say the version and exit.")]


@app.callback()
def _options(version: Version = False) -> None:
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
    app.command(cls=Command)(_command)


@app.command(cls=Command)
def fit(
    data: Annotated[str, Argument(metavar="DATA", help="Store, or ECSV table of binned spectra.")],
    config: Config,
    model: Annotated[list[str] | None, Option(help="constant, linear, spline or orientation; repeatable.")] = None,
    ell_min: Annotated[int | None, Option(min=0, help="First ell of the data.")] = None,
    ell_max: Annotated[int | None, Option(min=2, help="Last ell of the data.")] = None,
    pair: Annotated[str | None, Option(help='Pair of maps, for example "W1,W1"; default: the first.')] = None,
    mode: Annotated[list[str] | None, Option(help="Such as L2M0d0; repeatable; default: A20 at d = 0 and 2.")] = None,
    kind: Annotated[str | None, Option(help="plain, or difference to the controls, the default where known.")] = None,
    order: Annotated[str, Option(help="leading, exact, or auto: exact where the data tell them apart.")] = "auto",
    covariance: Annotated[Path | None, Option(metavar="STORE", help="Covariance of one of its realizations.")] = None,
    knots: Annotated[int, Option(min=2, help="Of a spline, 3 or more.")] = 4,
    each: Annotated[bool, Option("--each", help="Fit every realization of a store too, for the pulls.")] = False,
    as_json: Annotated[bool, Option("--json", help="Print JSON.")] = False,
    output: Png = None,
) -> None:
    """Fit an effective beam, b_l2 f_l with f_l = alpha or alpha + beta l, to measured or simulated spectra."""
    from mcsim import beamfit
    from mcsim.ensemble.expectation import survey_of
    from mcsim.plot.fit import fit_figure

    target, nthreads = picture(output, data, "-fit"), os.cpu_count() or 1
    span = None if ell_min is None and ell_max is None else (ell_min or 0, 1 << 30 if ell_max is None else ell_max)
    selection = beamfit.Selection(tuple(mode or beamfit.QUADRUPOLE), span, kind, pair)  # type: ignore[arg-type]
    survey = survey_of(config, nthreads)
    measured = beamfit.measurement(data, survey, selection, covariance)
    names = model or ["constant", "linear"]
    fits = beamfit.fit_models(measured, survey, names, knots=knots, order=order, nthreads=nthreads)  # type: ignore[arg-type]
    if each:
        fits = [beamfit.fit_each(one) for one in fits]
    if as_json:
        print(json.dumps([one.to_dict() for one in fits], indent=2, ensure_ascii=False))
    else:
        print(beamfit.report(fits))
    save(fit_figure(fits), target, aside=as_json)


@app.command(cls=Command)
def beam(
    source: Annotated[str, Argument(metavar="BEAM", help="Beam map, b_lm or B_l (FITS), B_l (text), or a CONFIG.")],
    lmax: Annotated[int | None, Option(min=2, max=8192, help="Default: 2048, or all that the file has.")] = None,
    m_max: Annotated[int | None, Option(min=0, help="Order; default: chosen from the beam.")] = None,
    pixel_deg: Annotated[float | None, Option(help="Side of a pixel of a beam map; default: its header's.")] = None,
    output: Png = None,
) -> None:
    """Print a beam's solid angle, widths, B_l and b_lm; draw it."""
    from mcsim.plot.look import look_at_beams

    target, looks = picture(output, source, "-beam"), list(look_at_beams(source, lmax, m_max, pixel_deg))
    for look in looks:
        print(look.text)
        save(look.figure, target if len(looks) == 1 else target.with_stem(f"{target.stem}-{look.name}"))


@app.command(cls=Command)
def scan(
    model: Annotated[str, Argument(metavar="MODEL", help="Scan model: a packaged name such as wmap, or TOML.")],
    nside: Annotated[int, Option(help="Resolution of the moments.")] = 256,
    smax: Annotated[int, Option(min=2, help="Largest s of the moments w_s.")] = 4,
    frame: Annotated[str, Option(help="ecliptic, galactic or equatorial.")] = "ecliptic",
    sample_period_s: Annotated[float | None, Option(help="Time between samples; default: the model's.")] = None,
    line_of_sight: Annotated[str | None, Option(help="One of the model's lines of sight.")] = None,
    output: Png = None,
) -> None:
    """Print the hits, the orientation moments and the three factors of a scan; draw them."""
    from mcsim.plot.look import look_at_scan

    target = picture(output, model, "-scan")
    look = look_at_scan(model, nside, smax, frame, sample_period_s, line_of_sight)
    print(look.text)
    save(look.figure, target)


@app.command(cls=Command)
def diagnose(
    model: Config,
    data: Annotated[
        Path, Argument(metavar="DATA", help="Folder with CHANNEL.fits or CHANNEL_SPLIT.fits, or ECSV table of spectra.")
    ],
    output: Annotated[
        Path | None, Option("-o", "--output", metavar="DIR", help="Folder for verdict and report; not of --dry-run.")
    ] = None,
    case: Annotated[str | None, Option(help="Name of the case; default: that of the model.")] = None,
    without: Annotated[list[str] | None, Option(metavar="EFFECT", help="Do not propose it; repeatable.")] = None,
    only: Annotated[list[str] | None, Option(metavar="EFFECT", help="Propose no other; repeatable.")] = None,
    including: Including = None,
    simulations: Simulations = None,
    quick: Annotated[bool, Option("--quick", help="First verdict, from fewer simulations.")] = False,
    controls: Annotated[int, Option(min=0, help="Perfect data sets, drawn at higher fidelity and diagnosed too.")] = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    dry_run: Annotated[bool, Option("--dry-run", help="Read DATA; say what it takes; no verdict.")] = False,
) -> None:
    """Test maps against a model, and find the effect that the model lacks: where, how large, and if adding it helps."""
    # Threads that share small matrices wait for each other, while workers want their cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    loaded("mcsim.diagnosis.api")
    from mcsim import config
    from mcsim.datavector.settings import DiagnosisSettings
    from mcsim.diagnosis.api import describe
    from mcsim.diagnosis.api import diagnose as judge
    from mcsim.diagnosis.words import summary

    where, run = chosen(workers, scheduler), config.load(model)
    chosen_settings = DiagnosisSettings.quick if quick else DiagnosisSettings
    settings = chosen_settings(
        without=tuple(without or ()), only=tuple(only or ()), including=tuple(including or ()),
        simulations=simulations, controls=controls,
    )  # fmt: skip
    if dry_run:
        if (number := processes(where)) is not None:
            run = replace(run, compute=replace(run.compute, workers=max(number, 1)))
        print(describe(run, settings, data))
        return
    if output is None:
        raise InputError(
            "diagnose writes a verdict and a report, and no folder is named for them; give one with -o DIR."
        )
    found = judge(run, data, output, case=case, settings=settings, quiet=False, workers=where)
    print("\n".join(summary(found, output)))


@app.command(cls=Command)
def limit(
    model: Config,
    output: Annotated[
        Path | None, Option("-o", "--output", metavar="DIR", help="Folder for limit.json, limit.zarr and limit.png.")
    ] = None,
    only: Annotated[list[str] | None, Option(metavar="EFFECT", help="Only this name or FILE.py; repeatable.")] = None,
    without: Annotated[list[str] | None, Option(metavar="EFFECT", help="Leave it out; repeatable.")] = None,
    nuisance: Annotated[
        list[str] | None, Option(metavar="EFFECT[:CHANNEL]=WIDTH", help="Unknown within this prior; repeatable.")
    ] = None,
    unknown_dipole_uk: Annotated[float, Option(help="Rms of a monopole and dipole of which nothing is known.")] = 0.0,
    probes: Annotated[int, Option(min=3, help="Random probes.")] = 64,
    orders: Annotated[int, Option(min=0, help="Orders of the fiducial beams in the inverse covariance.")] = 0,
    dense: Annotated[bool, Option("--dense", help="Whole matrices, for small maps.")] = False,
    dry_run: Annotated[bool, Option("--dry-run", help="Say memory and time; compute nothing.")] = False,
) -> None:
    """Say how small an effect these maps could tell at best, before any data, and which effects look alike."""
    from mcsim import config
    from mcsim.information.api import describe, widths
    from mcsim.information.api import limit as compute
    from mcsim.information.settings import LimitSettings

    settings = LimitSettings(
        only=tuple(only or ()),
        without=tuple(without or ()),
        nuisances=widths(nuisance or ()),
        unknown_dipole_uk=unknown_dipole_uk,
        probes=probes,
        orders=orders,
        dense=dense,
    )
    if dry_run:
        print(describe(config.load(model), settings))
        return
    found = compute(model, output, settings=settings, quiet=False)
    print("\n".join(found.lines()))
    if output is not None:
        print(f"written: {output / 'limit.json'}, {output / 'limit.zarr'}, {output / 'limit.png'}")


@app.command(cls=Command)
def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Folder of maps, or a configuration.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The same skies from another simulation.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the result and report.")],
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="CONFIG", help="What A simulates; default: a side that is one, model.toml in A or B, or beside."
        ),
    ] = None,
    accuracy: Annotated[float, typer.Option(help="Rms over the sky's up to which maps may be identical.")] = 1e-3,
    fail_above: Annotated[
        float | None, typer.Option(min=0.0, help="Exit with code 1 if the rms over the sky's is above this.")
    ] = None,
) -> None:
    """Explain why two simulations of the same skies differ: by what, where, how much, and what is left."""
    from mcsim.comparison.api import compare as compare_

    found = compare_(a, b, model, output, accuracy=accuracy, quiet=False)
    print(found)
    print(f"written: {output / 'compare.json'}, {output / 'report.html'}")
    if fail_above is not None and found.accuracy > fail_above:
        raise typer.Exit(1)


challenge = typer.Typer(
    cls=Group, help="Benchmark the diagnosis on effects that are drawn and sealed.", no_args_is_help=True
)
app.add_typer(challenge, name="challenge")

Folder = Annotated[Path, Argument(metavar="DIR", help="Folder of the challenge.")]
Target = Annotated[Path, Option("-o", "--output", metavar="DIR", help="Folder to fill.")]
Weakest = Annotated[float, Option(help="Smallest expected S/N of an effect.")]
Strongest = Annotated[float, Option(help="Largest expected S/N of an effect.")]


@challenge.command("make", cls=Command)
def challenge_make(
    model: Config,
    output: Target,
    cases: Annotated[int, Option(min=1, help="Number of cases.")] = 200,
    seed: Annotated[int, Option(min=0, help="Of the draws; keep it as secret as the keys.")] = 0,
    sampled_share: Annotated[float, Option(min=0.0, max=1.0, help="Share of maps made sample by sample.")] = 0.5,
    weakest: Weakest = 3.0,
    strongest: Strongest = 20.0,
    inventions: Annotated[Path | None, Option(metavar="FILE", help="Python file of effects in no library.")] = None,
    including: Including = None,
    simulations: Simulations = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Draw effects, make the maps of the cases, seal the keys."""
    from mcsim import config
    from mcsim.benchmark.case import Prior
    from mcsim.benchmark.challenge import make
    from mcsim.benchmark.folder import Settings

    file = None if inventions is None else str(inventions)
    shared = Settings(
        config.load(model),
        Prior(weakest=weakest, strongest=strongest),
        sampled_share=sampled_share,
        out_of_library=file,
        simulations=simulations,
        including=tuple(including or ()),
    )
    make(shared, output, cases, seed, workers=chosen(workers, scheduler), quiet=False)


@challenge.command("run", cls=Command)
def challenge_run(folder: Folder, workers: Workers = None, scheduler: Scheduler = None) -> None:
    """Diagnose all cases that have no verdict."""
    from mcsim.benchmark.challenge import run as diagnose_all

    print(f"{diagnose_all(folder, workers=chosen(workers, scheduler), quiet=False)} cases diagnosed")


@challenge.command("score", cls=Command)
def challenge_score(folder: Folder, workers: Workers = None, scheduler: Scheduler = None) -> None:
    """Open the keys and score the verdicts."""
    from mcsim.benchmark import report, score

    print("\n".join(report.lines(score.score(folder, workers=chosen(workers, scheduler), quiet=False))))


@challenge.command("draws", cls=Command)
def challenge_draws(
    model: Config,
    output: Target,
    number: Annotated[int, Option(min=1, help="Number of draws.")] = 1000,
    seed: Annotated[int, Option(min=0, help="Of the draws.")] = 0,
    weakest: Weakest = 3.0,
    strongest: Strongest = 20.0,
    including: Including = None,
    simulations: Simulations = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Draw and score compressed data vectors, without maps."""
    from mcsim import config
    from mcsim.benchmark import report, score
    from mcsim.benchmark.case import Prior
    from mcsim.benchmark.folder import Settings

    shared = Settings(
        config.load(model),
        Prior(weakest=weakest, strongest=strongest),
        simulations=simulations,
        including=tuple(including or ()),
    )
    found = score.score_draws(shared, output, number, seed, workers=chosen(workers, scheduler), quiet=False)
    print("\n".join(report.lines(found)))


@app.command(cls=Command)
def effects(name: Annotated[str | None, Argument(metavar="EFFECT", help="Only this name or FILE.py.")] = None) -> None:
    """List the library of effects: what a run can add and a diagnosis can find."""
    from mcsim import systematics as library

    for kind in library.catalogue().values() if name is None else [library.get(name)]:
        parameters = ", ".join(f"{field.name} = {field.default!r}" for field in fields(kind))
        typer.secho(f"{kind.name} ({kind.scope}; amplitude in {kind.unit})", bold=True)
        print(f"  parameters  {parameters}")
        for bound in kind.bounds:
            print(f"  possible    {bound.parameter} from {bound.low:g} to {bound.high:g}: {bound.source}")
        if not kind.proposed:
            print(f"  proposed    on request: mcsim diagnose --with {name or kind.name}")
        for key in ("cause", "signature", "source"):
            print(f"  {key:<11} {getattr(kind, key)}")


@app.command(cls=Command)
def bench(
    nside: Annotated[int, Option(help="Resolution of the maps.")] = 512,
    lmax: Annotated[int, Option(min=2, help="Degree of the analysis.")] = 1024,
    repeats: Annotated[int, Option(min=1, help="Pairs of timings.")] = 5,
) -> None:
    """Measure this machine: a realization over the transforms that it needs, workers, moments."""
    from mcsim.ensemble.bench import bench as measure

    for line in measure(nside, lmax, repeats):
        print(line)


@app.command(cls=Command)
def config(
    name: Annotated[str | None, Argument(metavar="CONFIG", help="Check it and print it resolved.")] = None,
    schema: Annotated[bool, Option("--schema", help="Print the JSON schema of the TOML file.")] = False,
) -> None:
    """Check a configuration, or print the schema of all."""
    from mcsim import config as config_

    if schema and name is not None:
        raise InputError(f"--schema prints the schema of all configurations and checks none; leave it or {name} out.")
    if schema:
        print(json.dumps(config_.json_schema(), indent=2))
    elif name is not None:
        loaded = config_.load(name)
        # They load slowly: what cannot be read is said before.
        from mcsim.simulation.channels import check_beams, check_effects, check_scans
        from mcsim.simulation.nuisance import check_nuisances
        from mcsim.simulation.preparation import check_preparations

        check_beams(loaded)
        check_scans(loaded)
        check_effects(loaded)
        check_nuisances(loaded)
        check_preparations(loaded)
        plain = {"digest": config_.digest(loaded), **config_.complete(loaded)}
        print(json.dumps(plain, indent=2, ensure_ascii=False))
    else:
        raise InputError("Nothing was asked for; give a configuration to check, or --schema.")
