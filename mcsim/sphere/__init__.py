"""The sphere: coefficients, pixels, rotations, masks, spectra, Gaussian skies, random streams, Wigner symbols."""
