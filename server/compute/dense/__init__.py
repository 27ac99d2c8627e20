"""Dense fields of the steps of a sequence."""
