"""Checks of a whole bench: machine, disk, cameras, stage, each with the measured value, its limit and what to do."""

from server.doctor.report import Check, Report
from server.doctor.run import examine

__all__ = ["Check", "Report", "examine"]
