"""A verification certificate: measured results beside what is known, judged, and as a page."""
