"""Benchmark a diagnosis on sealed cases: draw effects, make maps, diagnose them, and score beside the Bayes optimum."""
