"""Reading of files that a client sent, in a process that can open nothing."""
