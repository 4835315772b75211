"""Figures, drawn on matplotlib's Figure without global state."""
