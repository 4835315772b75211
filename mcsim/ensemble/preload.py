"""What local workers have in common: loaded once, in the process that they are forks of, or in each of them."""

import signal

from mcsim.support.loading import loaded

# Ctrl-C reaches all processes of a terminal. The driver ends the run; workers that lose the driver stay silent.
signal.signal(signal.SIGINT, signal.SIG_IGN)

loaded("distributed.nanny")
loaded("mcsim.ensemble.tasks")
