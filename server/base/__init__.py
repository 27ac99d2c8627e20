"""Parts that the whole service uses: errors, problems, logs, metrics, wire models' base."""
