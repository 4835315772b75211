"""What local workers have in common: loaded once, in the process that they are forks of, or in each of them."""

import signal
import warnings

from mcsim.support.loading import loaded

# Ctrl-C reaches all processes of a terminal. The driver ends the run; workers that lose the driver stay silent.
signal.signal(signal.SIGINT, signal.SIG_IGN)

# The driver reads the same files, and has said so; what numbers do is said where they are.
warnings.filterwarnings("ignore", category=UserWarning, module=r"mcsim\.")

loaded("distributed.nanny")
loaded("mcsim.ensemble.tasks")
