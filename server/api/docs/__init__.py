"""The API's own description and the static files."""
