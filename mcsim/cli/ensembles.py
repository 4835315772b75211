"""Commands for ensembles: run, join, inspect, draw, predict."""

import os
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from mcsim.cli.common import Config, Part, Png, Processes, Scheduler, chosen, picture, processes, save
from mcsim.errors import InputError
from mcsim.support.loading import loaded

Store = Annotated[Path, Argument(metavar="STORE", help="Folder that mcsim run wrote.")]


def run(
    config: Config,
    store: Annotated[Path | None, Option("-o", "--output", metavar="STORE", help="Default: NAME.zarr here.")] = None,
    resume: Annotated[bool, Option("--resume", help="Check a store, repair it, and continue it.")] = False,
    realizations: Part = None,
    workers: Processes = None,
    scheduler: Scheduler = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Say what is left, memory, disk, files, time; compute nothing.")
    ] = False,
) -> None:
    """Run an ensemble; continue it if it was interrupted; extend it if more realizations are asked for.

    With --resume the store is checked first, and damaged realizations are computed again. STORE.log beside the store
    records the events.

    Exit codes: 0 done; 1 realizations failed or the run could not continue (finished ones are stored: run again); 2 bad
    input, nothing was computed; 130 interrupted by Ctrl-C or SIGTERM (run again to continue).
    """
    where, part = chosen(workers, scheduler), _slice(realizations)
    if dry_run:
        from mcsim.ensemble import plan

        print(plan.describe(config, part, processes(where), store, resume))
        return
    runner = loaded("mcsim.ensemble.runner")
    _report(runner.run(config, store, resume=resume, realizations=part, workers=where, quiet=False))


def merge(
    slices: Annotated[list[Path], Argument(metavar="STORE...", help="Stores of slices of one ensemble.")],
    store: Annotated[Path, Option("-o", "--output", metavar="STORE", help="Store to make.")],
) -> None:
    """Join slices that were run with --realizations A:B."""
    from mcsim.ensemble import runner
    from mcsim.ensemble import store as stores

    found = runner.merge(slices, store, quiet=False)
    size = stores.size(found.store)
    if found.finished == size:
        _report(found)
        return
    print(
        f"{found.store}: {found.finished} of {size} realizations, {size - found.finished} are missing; merge it with "
        "the slices that have them, or compute them with mcsim run."
    )


def info(
    store: Store,
    export: Annotated[
        Path | None, Option(metavar="FILE", help="Write the summary: .nc or .zarr; .ecsv, .fits or .csv.")
    ] = None,
    verify: Annotated[bool, Option("--verify", help="Read every file; exit code 1 if anything is damaged.")] = False,
) -> None:
    """Describe a store; export its summary; verify it."""
    if verify and export is not None:
        raise InputError(f"--verify writes nothing, so not {export} either; give --export in a command of its own.")
    if verify:
        from mcsim.ensemble import repair

        verdict = repair.verify(store, quiet=False)
        print(verdict.text())
        raise typer.Exit(0 if verdict.intact else 1)
    from mcsim.ensemble import describe, opening, tables

    if export is not None:
        tables.check_output(export)
    print(describe.describe(store))
    if export is not None:
        with opening.open_summary(store) as summary:
            tables.write(opening.read_in(summary, store), export)
        print(f"wrote {export}")


def plot(
    store: Store,
    output: Png = None,
    L: Annotated[int | None, Option("--L", help="Only this L.")] = None,
    M: Annotated[int | None, Option("--M", help="Only this M.")] = None,
    d: Annotated[int | None, Option("--d", help="Only this d = l2 - l1.")] = None,
    pair: Annotated[str | None, Option(help='Pair of maps, for example "W1,W1"; default: the first.')] = None,
    predict: Annotated[str | None, Option(metavar="CONFIG", help="Draw its prediction, or that of predict -o.")] = None,
    exact: Annotated[bool, Option("--exact", help="The prediction to all orders in the beam.")] = False,
    bare: Annotated[bool, Option("--no-caption", help="Draw neither title nor notes, as for a paper.")] = False,
) -> None:
    """Draw the binned spectra of a store with error bars, and optionally a prediction."""
    from mcsim.ensemble import prediction, tables
    from mcsim.ensemble import store as stores
    from mcsim.plot.spectra import ensemble_figure

    if exact and predict is None:
        raise InputError("--exact says how to predict, but no prediction is asked for; add --predict, or leave it out.")
    stores.attributes(store)
    target = picture(output, store)
    expected = None
    if predict is not None and Path(predict).suffix in tables.ENDINGS:
        if exact:
            raise InputError(f"--exact says how to predict, but {predict} is predicted already; leave it out.")
        expected = tables.read_prediction(predict)
    elif predict is not None:
        expected = prediction.predict(predict, exact=exact, nthreads=os.cpu_count() or 1)
    figure = ensemble_figure(store, L=L, M=M, d=d, pair=pair, prediction=expected, caption=not bare)
    save(figure, target)


def predict(
    config: Config,
    exact: Annotated[bool, Option("--exact", help="To all orders in the beam; default: leading order.")] = False,
    snr: Annotated[bool, Option("--snr", help="Add the signal to noise of every mode.")] = False,
    output: Annotated[
        Path | None, Option("-o", "--output", metavar="FILE", help=".zarr or .nc; .ecsv, .fits or .csv.")
    ] = None,
    workers: Annotated[int | None, Option(min=1, help="Local processes, for the pairs of maps; default: one.")] = None,
    scheduler: Scheduler = None,
) -> None:
    """Predict the summary of a run without Monte Carlo."""
    from mcsim.ensemble import describe, prediction, tables

    where = chosen(workers, scheduler)
    if output is not None:
        tables.check_output(output)
    expected = prediction.predict(config, exact=exact, snr=snr, nthreads=os.cpu_count() or 1, workers=where)
    print(describe.describe_prediction(expected))
    if output is not None:
        tables.write(expected, output)
        print(f"wrote {output}")


def maps(
    config: Config,
    folder: Annotated[Path, Option("-o", "--output", metavar="DIR", help="Folder to fill; nothing is replaced.")],
    realization: Annotated[int | None, Option(metavar="N", help="Only this one, its files directly in DIR.")] = None,
    realizations: Part = None,
    sample_by_sample: Annotated[bool, Option("--sample-by-sample", help="By the time-ordered reference.")] = False,
) -> None:
    """Write the maps of a run as FITS files, which mcsim diagnose can read.

    A folder for each realization holds CHANNEL.fits or CHANNEL_SPLIT.fits: HEALPix in RING order, uK. Those that an
    interrupted command has written are kept: give it again, and it goes on.
    """
    from mcsim.ensemble.maps import write_maps

    if realization is not None and realizations is not None:
        raise InputError("--realization and --realizations exclude each other; give one of them.")
    chosen = _slice(realizations) if realization is None else realization
    found = write_maps(config, folder, chosen, sample_by_sample=sample_by_sample, quiet=False)
    print(f"maps of {len(found)} realization{'' if len(found) == 1 else 's'} are in {folder}")


def prepare(
    config: Config,
    maps: Annotated[list[str], Argument(metavar="MAP...", help="CHANNEL.fits or CHANNEL_SPLIT.fits, or NAME=FILE.")],
    folder: Annotated[Path, Option("-o", "--output", metavar="DIR", help="Folder to fill; nothing is replaced.")],
) -> None:
    """Prepare observed maps as CONFIG prepares its simulated maps, by its steps of preparation."""
    from mcsim.ensemble.prepare import prepare_files

    for path in prepare_files(config, maps, folder):
        print(f"wrote {path}")


def _slice(text: str | None) -> slice | None:
    if text is None:
        return None
    start, colon, stop = text.partition(":")
    if not colon or not (start or "0").isdecimal() or (stop and not stop.isdecimal()):
        raise InputError(f"--realizations {text} is not of the form A:B with whole numbers; for example 0:50.")
    return slice(int(start or 0), int(stop) if stop else None)


def _report(result) -> None:  # type: ignore[no-untyped-def]
    if result.computed == 0 and not result.failures:
        more = "; its summary is new" if result.summarised else ", nothing to do"
        print(f"{result.store} is finished: {result.finished} realizations{more}.")
    else:
        print(f"{result.store}: {result.finished} realizations, {result.computed} of them new.")
    for failure in result.failures[:10]:
        print(f"realization {failure.realization} failed: {failure.reason}")
    if result.failures:
        print(f"{len(result.failures)} realizations failed; run the same command again to retry them.")
        raise typer.Exit(1)
