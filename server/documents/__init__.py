"""Documents that the data folder keeps, one model each: stores, reports and the API's replies read the same."""
