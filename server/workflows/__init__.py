"""What the service does on request: captures, sequences, calibrations, analyses, reviews."""
