#!/bin/sh
# A scheduler and workers in one SLURM job: sbatch slurm.sh run.toml [more options of mcsim run]
# All nodes see this folder and the files that the configuration names. When the time is over SLURM sends SIGTERM: the run
# ends in order with exit code 130, and the same sbatch goes on where it stopped.
#SBATCH --job-name=mcsim
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=16
#SBATCH --cpus-per-task=1
#SBATCH --time=04:00:00
#SBATCH --signal=B:TERM@120

file="scheduler-$SLURM_JOB_ID.json"
export OMP_NUM_THREADS=1 DUCC0_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
export MALLOC_TRIM_THRESHOLD_=268435456 MALLOC_MMAP_THRESHOLD_=268435456 # memory of maps is kept for the next ones

# The scheduler has no password: it listens on the network of the cluster alone. See tls.yaml where that is shared.
dask scheduler --scheduler-file "$file" --interface "${INTERFACE:-ib0}" --dashboard-address 127.0.0.1:0 &
scheduler=$!
while [ ! -s "$file" ]; do sleep 1; done

# --no-nanny would leave a node without its worker after a crash; the limit of memory is SLURM's.
srun dask worker --scheduler-file "$file" --interface "${INTERFACE:-ib0}" --nthreads 1 --memory-limit 0 --no-dashboard &
workers=$!

address=$(python -c "import json, sys; print(json.load(open(sys.argv[1]))['address'])" "$file")
mcsim run "$@" --scheduler "$address" &
driver=$!
trap 'kill -TERM "$driver"' TERM INT
wait "$driver"
code=$?
while kill -0 "$driver" 2>/dev/null; do wait "$driver"; code=$?; done # a trap ends the first wait
kill "$workers" "$scheduler"
rm -f "$file"
exit "$code"
