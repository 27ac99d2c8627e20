"""Routes: tests, steps, metadata, watch mode, trash."""
