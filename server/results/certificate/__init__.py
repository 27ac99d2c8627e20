"""Request of a verification certificate, and its findings."""
