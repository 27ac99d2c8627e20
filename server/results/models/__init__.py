"""Results compared with models: the request, the comparison, the document."""
