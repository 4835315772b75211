#!/bin/sh
# A job array without any scheduler of Dask: every element runs a slice into a store of its own, on one node.
#   qsub -v CONFIG=run.toml,TOTAL=10000,ELEMENTS=100 -J 0-99 pbs-array.sh
# and when all are done:
#   mcsim merge slices/*.zarr -o run.zarr
# An element that was killed is submitted again with the same index: it continues its slice.
#PBS -N mcsim-slice
#PBS -l select=1:ncpus=16
#PBS -l walltime=04:00:00

cd "$PBS_O_WORKDIR" || exit 2
index=${PBS_ARRAY_INDEX:-$SLURM_ARRAY_TASK_ID} # the same script serves sbatch --array=0-99
first=$((TOTAL * index / ELEMENTS))
stop=$((TOTAL * (index + 1) / ELEMENTS))
mkdir -p slices
exec mcsim run "$CONFIG" --realizations "$first:$stop" --workers "${NCPUS:-${SLURM_CPUS_PER_TASK:-1}}" \
    -o "slices/$(printf %05d "$index").zarr"
