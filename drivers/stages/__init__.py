"""Motion stages: the protocol, serial lines, and the common parts of all drivers."""
