"""The rig file and its reference."""
