"""``python -m mcsim``."""

from mcsim.cli import main

main()
