"""From a configuration and a sky to maps: by orientation moments, on rings, sample by sample, or from differences."""
