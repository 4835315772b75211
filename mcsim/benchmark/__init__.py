"""Challenges: effects drawn, hidden and sealed, diagnosed as one batch, and scored beside the best that is possible."""
