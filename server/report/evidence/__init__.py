"""Parts of the report that show what a result is worth beside others."""
