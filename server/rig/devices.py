"""Devices connected to this machine: cameras by every driver, serial ports, and the faults of each.

Each driver searches in a thread of its own and within a time limit, so that one that hangs or lacks a library spoils
nothing but its own part of the list. Nothing is opened, and no byte goes to a serial port: a device that no file names
may be anything.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS
from stereorig.drivers.cameras.protocol import FoundDevice
from stereorig.drivers.registry import CAMERA_DRIVERS, discover_cameras
from stereorig.drivers.stages.serial_ports import discover_ports
from stereorig.server.base.models import always_there
from stereorig.server.rig.rig import Rig

#: name of the search for serial ports, in addition to the camera drivers' names
SERIAL = "serial"


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ListedDevice(_Closed, FoundDevice):
    """A camera or a serial port."""

    model_config = ConfigDict(json_schema_extra=always_there)

    in_use_by: str | None = Field(description="`cam1`, `cam2` or `stage` when this service itself uses it.")


class DriverState(_Closed):
    """Outcome of one driver's search."""

    name: str = Field(description="Name of the driver; `serial` searches for serial ports.", examples=["aravis"])
    state: Literal["ok", "missing", "failed", "timeout"] = Field(
        description="`missing`: a library is not installed; `timeout`: no answer in time."
    )
    found: int = Field(description="Number of devices found.")
    problem: str | None = Field(description="Error of the search; null if there was none.")
    remedy: str | None = Field(description="Remedy, such as packages to install.")


class DeviceListing(_Closed):
    """Everything that was found."""

    cameras: list[ListedDevice] = Field(description="Cameras that a driver finds, and those that this service holds.")
    serial_ports: list[ListedDevice] = Field(description="Serial ports; none is opened or asked who it is.")
    drivers: list[DriverState] = Field(description="Outcome of each driver's search.")


@dataclass(frozen=True)
class HeldDevice:
    """A device that this service has open; ``problem`` when it has lost it."""

    name: str  # cam1, cam2 or stage
    driver: str
    device: str
    model: str = ""
    serial: str = ""
    problem: str | None = None


def held_by(rig: Rig) -> list[HeldDevice]:
    """Return the devices that a running rig has open, without asking any device."""
    if not rig.is_open:
        return []
    held = []
    for cam in CAMERAS:
        section, shown = rig.config.camera(cam), rig.describe_camera(cam)
        device = shown.device
        if device is None:  # it was not found yet
            continue
        fault = shown.fault
        held.append(
            HeldDevice(
                cam,
                section.driver,
                section.device or cam,
                device.model,
                device.serial,
                None if fault is None else f"{fault.detail} {fault.remedy}".strip(),
            )
        )
    stage = rig.config.stage
    return held + [HeldDevice("stage", SERIAL, line.url) for line in (stage.lines(rig.config.axes) if stage else [])]


class _Search:
    """One driver's search, in a thread of its own."""

    def __init__(self, name: str, find: Callable[[], list[FoundDevice]]) -> None:
        self.name = name
        self._find = find
        self._found: list[FoundDevice] = []
        self._error: Exception | None = None
        self.done = threading.Event()

    def start(self) -> None:
        threading.Thread(target=self._run, name=f"search for {self.name}", daemon=True).start()

    def _run(self) -> None:
        try:
            self._found = list(self._find())
        except Exception as error:  # noqa: BLE001  # any error of a driver concerns its own part of the list alone
            self._error = error
        finally:
            self.done.set()

    def result(self, deadline: float, limit_s: float) -> tuple[list[FoundDevice], DriverState]:
        if not self.done.wait(max(0.0, deadline - time.monotonic())):
            problem = f"The search has not come to an end within {limit_s:g} s."
            remedy = "Look again in a while; unplug devices one by one if it stays so."
            return [], DriverState(name=self.name, state="timeout", found=0, problem=problem, remedy=remedy)
        error = self._error
        if error is None:
            return self._found, DriverState(
                name=self.name, state="ok", found=len(self._found), problem=None, remedy=None
            )
        if isinstance(error, StereorigError):
            state: Literal["missing", "failed"] = "missing" if error.code == "driver_missing" else "failed"
            return [], DriverState(name=self.name, state=state, found=0, problem=error.cause, remedy=error.remedy)
        problem = f"{type(error).__name__}: {error}"
        if isinstance(error, ImportError):
            remedy = "Install the package that the message names."
            return [], DriverState(name=self.name, state="missing", found=0, problem=problem, remedy=remedy)
        return [], DriverState(
            name=self.name, state="failed", found=0, problem=problem, remedy="Report this with the message above."
        )


class DeviceFinder:
    """Looks for devices; a search that still hangs is waited for, never started a second time.

    Parameters
    ----------
    drivers
        Names of the camera drivers; all that there are when left out.
    discover, ports
        Search for cameras of one driver, and for serial ports.
    """

    def __init__(
        self,
        drivers: Iterable[str] | None = None,
        *,
        discover: Callable[[str], list[FoundDevice]] = discover_cameras,
        ports: Callable[[], list[FoundDevice]] = discover_ports,
    ) -> None:
        self._drivers = sorted(CAMERA_DRIVERS if drivers is None else drivers)
        self._discover = discover
        self._ports = ports
        self._lock = threading.Lock()
        self._searches: dict[str, _Search] = {}

    def find(self, *, timeout_s: float = 5.0, held: Iterable[HeldDevice] = ()) -> DeviceListing:
        """List every device found within ``timeout_s`` seconds; ``held`` are the devices that this service uses."""
        deadline = time.monotonic() + timeout_s
        with self._lock:
            searches = [self._search(name) for name in (*self._drivers, SERIAL)]
        results = [search.result(deadline, timeout_s) for search in searches]
        found = [device for devices, _ in results for device in devices]
        holders = list(held)
        listed = [_listed(device, next((h for h in holders if _same(device, h)), None)) for device in found]
        seen = {device.in_use_by for device in listed}
        listed += [_unseen(holder) for holder in holders if holder.name not in seen and holder.driver != SERIAL]
        return DeviceListing(
            cameras=[device for device in listed if device.kind == "camera"],
            serial_ports=[device for device in listed if device.kind == "serial"],
            drivers=[state for _, state in results],
        )

    def _search(self, name: str) -> _Search:
        running = self._searches.get(name)
        if running is None or running.done.is_set():
            find = self._ports if name == SERIAL else lambda: self._discover(name)
            running = self._searches[name] = _Search(name, find)
            running.start()
        return running


def _same(found: FoundDevice, held: HeldDevice) -> bool:
    if found.kind == "serial":
        return held.driver == SERIAL and _same_path(found.device, held.device)
    if found.driver != held.driver:
        return False
    return is_called(found, held.device) or (
        bool(held.serial) and (found.serial, found.model) == (held.serial, held.model)
    )


def is_called(found: FoundDevice | ListedDevice, name: str) -> bool:
    """Return True if a rig file may mean this camera by ``name``: its id, address, serial number, or any path to it."""
    known = {found.device, found.address, found.serial} - {""}
    return name in known or any(_same_path(path, name) for path in (found.device, found.extra.get("node", "")))


def _same_path(one: str, two: str) -> bool:
    return one.startswith("/") and two.startswith("/") and Path(one).resolve() == Path(two).resolve()


def _listed(found: FoundDevice, holder: HeldDevice | None) -> ListedDevice:
    # a driver that finds the camera in use cannot distinguish this service from another program
    problem = found.problem if holder is None else holder.problem
    in_use_by = None if holder is None else holder.name
    return ListedDevice.model_validate(vars(found) | {"problem": problem, "in_use_by": in_use_by})


def _unseen(holder: HeldDevice) -> ListedDevice:
    found = FoundDevice(
        kind="camera", driver=holder.driver, device=holder.device, model=holder.model, serial=holder.serial
    )
    return _listed(found, holder)
