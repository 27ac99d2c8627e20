"""Resolution study: noise, spatial resolution and their product by spacing and strain window, from static steps."""
