"""Frame grabbers and stages: two protocols, one adapter a device family."""
