"""From two streams of frames to pairs: reader threads, frame counters, clocks, pairing."""
