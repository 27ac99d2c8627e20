"""What engineers read off fields: rigid motion, alignment, extensometers, lines, areas; each with its uncertainty."""
