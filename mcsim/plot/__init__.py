"""Figures, drawn on matplotlib's Figure without any global state."""
