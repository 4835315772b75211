"""The instrument: beams, scan models, pointing and the orientation moments of a scan."""
