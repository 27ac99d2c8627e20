"""Making certificates, and whether they still hold."""
