"""One adjustment for any lens, motion and target: both cameras, the stage, the board's poses and its points."""
