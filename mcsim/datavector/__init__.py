"""The data vector: what is measured in maps or spectra, its simulations, and its responses to effects."""
