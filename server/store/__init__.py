"""The data folder: files are the truth, the catalogue is an index."""
