"""Generators of strange configurations, damaged files and damaged stores, and the judge of what becomes of them."""
