"""Checks of a whole bench: machine, disk, cameras, stage, each with the measured value, its limit and a remedy."""

from stereorig.server.doctor.report import AllChecks, Check
from stereorig.server.doctor.run import examine

__all__ = ["AllChecks", "Check", "examine"]
