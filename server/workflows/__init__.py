"""Work of the service on request: captures, sequences, calibrations, analyses, reviews."""
