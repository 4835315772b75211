"""Where simulation and data part, which effect makes the gap, and how far it shrinks once the effect is added."""
