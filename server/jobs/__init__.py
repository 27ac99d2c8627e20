"""Jobs, who holds the hardware, events, and requests that have one effect."""
