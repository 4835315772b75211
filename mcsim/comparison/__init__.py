"""Explain why two simulations of the same skies differ."""
