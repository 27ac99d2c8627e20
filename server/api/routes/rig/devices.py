"""Devices connected to the machine that the service runs on."""

from __future__ import annotations

from fastapi import APIRouter

from server.api.protocol.dependencies import ServiceDep
from server.rig.devices import DeviceListing, held_by

router = APIRouter(tags=["rig"])


@router.get("/devices", summary="Cameras and serial ports, and what is wrong with each", response_model=DeviceListing)
def get_devices(service: ServiceDep) -> DeviceListing:
    """Look for devices for up to five seconds; the running rig is not disturbed, and no serial port is opened."""
    return service.finder.find(held=held_by(service.rig))
