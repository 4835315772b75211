"""Strange configurations and damaged files: each must end in a result or in one sentence, soon, and leave nothing.

python workflows/faults/fuzz.py --configurations 2000 --files 500
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from fuzzing import configurations, files, stores


def main() -> int:
    """Fuzz all three; exit code 1 if something ended in neither a result nor a sentence."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--configurations", type=int, default=2000)
    parser.add_argument("--files", type=int, default=500)
    parser.add_argument("--stores", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=300.0, help="for each of the three")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, help="write the counts as JSON")
    chosen = parser.parse_args()
    found = {}
    for name, subject in (("configurations", configurations), ("files", files), ("stores", stores)):
        with tempfile.TemporaryDirectory(prefix="mcsim-fuzz-") as folder:
            outcome = subject.fuzz(getattr(chosen, name), chosen.seed, chosen.seconds, Path(folder))
        found[name] = {"ends": dict(outcome.ends), "slowest_s": round(outcome.slowest_s, 2), "faults": outcome.faults}
        print(f"{name}: {dict(outcome.ends)}, slowest {outcome.slowest_s:.1f} s, {len(outcome.faults)} faults")
        for fault in outcome.faults:
            print(f"  {fault}")
    if chosen.output:
        chosen.output.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(result["faults"] for result in found.values()))


if __name__ == "__main__":
    sys.exit(main())
