"""What every part of the service may use: errors, problems, logs, metrics, wire models' base."""
