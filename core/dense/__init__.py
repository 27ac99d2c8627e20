"""A dense field: a vector every few pixels, from sums that neighbouring windows share."""
