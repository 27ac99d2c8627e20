"""The rig process: cameras, stage, pairing and stop, separate from the process that serves HTTP."""
