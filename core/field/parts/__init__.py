"""Parts of a subset: what each of them does to its match."""
