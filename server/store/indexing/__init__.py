"""When the catalogue's index is believed, and how it is made anew behind a running service."""
