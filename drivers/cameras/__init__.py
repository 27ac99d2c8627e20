"""Frame grabbers: the protocol and one adapter a device family."""
