"""Pairs of frames from two streams: reader threads, frame counters, clocks, pairing."""
