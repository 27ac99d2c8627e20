"""A verification certificate: measured results compared with known values, judged, and as a page."""
