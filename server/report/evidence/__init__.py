"""Parts of the report that compare a result with other sources."""
