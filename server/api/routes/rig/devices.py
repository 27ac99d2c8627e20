"""Devices connected to the machine that the service runs on, and channels that it reads."""

from __future__ import annotations

from fastapi import APIRouter

from stereorig.server.api.models.channels import ChannelsRead
from stereorig.server.api.protocol.dependencies import ServiceDep
from stereorig.server.rig.devices import DeviceListing, held_by

router = APIRouter(tags=["rig"])


@router.get("/devices", summary="Cameras and serial ports, with the faults of each", response_model=DeviceListing)
def get_devices(service: ServiceDep) -> DeviceListing:
    """Look for devices for up to five seconds; the running rig is not disturbed, and no serial port is opened."""
    return service.finder.find(held=held_by(service.rig))


@router.get("/channels", summary="Channels that the service reads")
def get_channels(service: ServiceDep) -> ChannelsRead:
    """Return each channel that the rig file names (`[[channels]]`): line, newest reading, fault.

    They are read all the time. A step has their values at its exposure, with their standard uncertainties.
    """
    return ChannelsRead.model_validate({"channels": service.channels.document()})
