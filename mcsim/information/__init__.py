"""Fisher information of maps: the smallest amplitudes of effects that any analysis of them could measure."""
