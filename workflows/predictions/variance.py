"""Say by how much pairing lowers the variance of A20: that of the plain spectrum over that of the paired difference.

python workflows/predictions/variance.py STORE
"""

import sys

import mcsim

summary = mcsim.open_summary(sys.argv[1]).sel(mode="L2M0d0")
plain, paired = (summary[f"biposh{kind}_binned_standard_deviation"] for kind in ("", "_difference"))
ratio = ((plain / paired) ** 2).transpose("pair", "bin").values
print("ell", *summary.pair.values, sep="\t")
for first, last, values in zip(summary.bin_first.values, summary.bin_last.values, ratio.T, strict=True):
    print(f"{first}-{last}", *(f"{value:.3g}" for value in values), sep="\t")
