"""``python -m mcsim.cli``."""

from mcsim.cli import main

main()
