"""Live measurement: frames taken, measured in a process of their own, and their values handed out."""
