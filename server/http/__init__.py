"""The HTTP server around the app: connections, systemd, keys."""
