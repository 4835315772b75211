"""Scan models, pointing, orientation moments of the beam, and their exact long-time limit."""
