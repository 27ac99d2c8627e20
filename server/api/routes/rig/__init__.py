"""Routes: cameras, stage, devices."""
