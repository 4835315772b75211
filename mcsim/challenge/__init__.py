"""Challenges: effects that are drawn, hidden and sealed, diagnosed as one batch, and scored beside the best possible."""
