"""Cracks in numbers: stress intensities, J, T-stress, opening and growth of a drawn crack, each with its interval."""
