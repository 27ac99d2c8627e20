"""Motion stages: the protocol, serial lines, and one driver a controller family."""
