"""Reading results for clients: variables, positions, previews, quality, staleness."""
