"""Simulated stage controllers: programs that speak the real wire protocols and move axes with mass and backlash."""
