"""Cost of learning a model, before it is simulated: time and memory of one simulation, measured; disk."""

import resource
import sys
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mcsim.datavector.analysis import Analysis, Job
from mcsim.datavector.bipolar_scan import coarse_residuals
from mcsim.datavector.campaign import Purpose
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.ensemble.plan import cost
from mcsim.simulation import simulate

SURVEYS = 2  #: surveys with effects that a worker holds besides the model
VERDICT = 2e8  #: bytes that the fits and the report take beside the model and the results of all simulations
SAMPLE_S = 2e-7  #: seconds that one sample of the time-ordered reference takes on one core


def lines(analysis: Analysis, jobs: Mapping[Purpose, Job]) -> list[str]:
    """Return lines on memory, disk and time of the simulations of a model by mcsim; two of them are made and timed.

    Notes
    -----
    The memory of a worker is the largest that this process has had, and the orientation moments of further surveys
    where they are not mapped from the cache, which all surveys and workers share. The command itself holds a survey,
    the results of all simulations, and the report: 0.50 to 0.64 GB for ``demo-model``.
    """
    survey = analysis.model.survey
    each_s = min(_seconds(analysis, number) for number in range(2))
    scan = 0
    if analysis.of_maps:
        filtered = wiener_filter(analysis.model, list(simulate.maps(survey, 0)))
        scan = len(analysis.bipolar_scan.elements) + coarse_residuals(analysis.model, filtered).size
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)
    own = [m for m in survey.maps if not isinstance(m.moments.w, np.memmap)]
    moments = sum(m.moments.w.nbytes + 3.0 * m.moments.hits.nbytes for m in own)
    number = sum(job.count for job in jobs.values() if job.source is None)
    sampled = sum(job.count for job in jobs.values() if job.sample_by_sample)
    samples_s = SAMPLE_S * float(sum(m.moments.hits.sum() for m in survey.maps)) * sampled
    row = len(analysis.elements) + len(analysis.slices)
    disk = 8.0 * sum(job.count * (row + scan * job.bipolar_scan) for job in jobs.values())
    run, workers = survey.config, survey.config.compute.workers
    mean = replace(cost(run), memory=peak + SURVEYS * moments, each_s=each_s + samples_s / max(number, 1))
    mean = replace(mean, driver=peak + disk + VERDICT)
    first, *rest = mean.lines(number, workers)
    kept = f"  disk    {disk / 1e6:.1f} MB in the cache; what is finished is kept, and a command that is killed goes on"
    return [first, kept, *rest]


def _seconds(analysis: Analysis, realization: int) -> float:
    """Return the processor time of one simulation and its data vector."""
    start = time.process_time()
    analysis.data_vector(list(simulate.maps(analysis.model.survey, realization)), slices=analysis.of_maps)
    return time.process_time() - start
