"""Routes: jobs, sessions of the page, health and metrics."""
